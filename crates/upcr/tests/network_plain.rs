//! The network against a form of it with edge tensors, in double precision.

#![allow(clippy::unwrap_used)]

#[path = "common/weights.rs"]
mod weights;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use upcr::neighbors::KdTree;
use upcr::net::{Graph, GraphKind, Invariant, Network, NetworkConfig, Representations};
use weights::{Precision, WeightsFile};

const INVARIANTS: [Invariant; 8] = [
    Invariant::None,
    Invariant::Distance,
    Invariant::Ppf,
    Invariant::Spfh,
    Invariant::Pfh,
    Invariant::DistancePpf,
    Invariant::DistanceSpfh,
    Invariant::DistancePpfSpfh,
];

/// Points of a bumpy ellipsoid.
fn surface(n: usize, seed: u64) -> Vec<[f32; 3]> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut coordinate = || rng.random_range(-1.0..1.0_f32);
    (0..n)
        .map(|_| {
            let v = [coordinate(), coordinate(), coordinate()];
            let length = v.iter().map(|x| x * x).sum::<f32>().sqrt() / (1.0 + 0.2 * (5.0 * v[0]).sin());
            [v[0] / length + 0.3, 0.8 * v[1] / length, 0.6 * v[2] / length - 0.1]
        })
        .collect()
}

type Rows = Vec<Vec<f64>>;

/// The network as its definition reads.
struct Plain<'a> {
    file: &'a WeightsFile,
    config: &'a NetworkConfig,
}

impl Plain<'_> {
    fn tensor(&self, name: &str) -> Vec<f64> {
        self.file.tensors[name].1.iter().map(|v| f64::from(*v)).collect()
    }

    /// Linear map, batch norm, leaky rectifier, and the maximum over each point's edges.
    fn over_edges(&self, name: &str, edges: &[Rows]) -> Rows {
        let part = |part: &str| self.tensor(&format!("{name}.{part}"));
        let (weight, gamma, beta, mean, var) =
            (part("weight"), part("gamma"), part("beta"), part("mean"), part("var"));
        let channels = gamma.len();
        let value = |edge: &[f64], c: usize| {
            let x: f64 = edge.iter().enumerate().map(|(k, v)| v * weight[k * channels + c]).sum();
            let y = gamma[c] * (x - mean[c]) / (var[c] + 1e-5).sqrt() + beta[c];
            if y < 0.0 { y * f64::from(self.config.negative_slope) } else { y }
        };
        let most = |edges: &Rows, c| edges.iter().map(|e| value(e, c)).fold(f64::NEG_INFINITY, f64::max);
        edges.iter().map(|edges| (0..channels).map(|c| most(edges, c)).collect()).collect()
    }

    fn branch(&self, name: &str, mut features: Rows, graph: &Graph) -> Vec<f64> {
        for l in 0..self.config.widths.len() {
            let found;
            let graph = match self.config.graph {
                GraphKind::Static => graph,
                GraphKind::Dynamic => {
                    found = nearest(&features, self.config.k);
                    &found
                }
            };
            let edge = |i: usize, j: u32| {
                let (a, b) = (&features[i], &features[j as usize]);
                a.iter().copied().chain(b.iter().zip(a).map(|(b, a)| b - a)).collect()
            };
            let edges: Vec<Rows> =
                (0..features.len()).map(|i| graph.row(i).iter().map(|&j| edge(i, j)).collect()).collect();
            features = self.over_edges(&format!("{name}.{l}"), &edges);
        }
        (0..features[0].len())
            .map(|c| features.iter().map(|row| row[c]).fold(f64::NEG_INFINITY, f64::max))
            .collect()
    }

    fn representations(&self, cloud: &[[f32; 3]]) -> [Vec<f64>; 4] {
        let n = cloud.len() as f64;
        let o = [0, 1, 2].map(|a| cloud.iter().map(|p| f64::from(p[a])).sum::<f64>() / n);
        let points: Vec<[f32; 3]> =
            cloud.iter().map(|p| [0, 1, 2].map(|a| (f64::from(p[a]) - o[a]) as f32)).collect();
        let neighborhoods = KdTree::new(&points).knn_graph(self.config.k);
        let graph = Graph::from(&neighborhoods);
        let x = points.iter().map(|p| p.iter().map(|v| f64::from(*v)).collect()).collect();
        let global = self.branch("global", x, &graph);
        let (invariant, pose) = if self.config.invariant == Invariant::None {
            (global.clone(), global.clone())
        } else {
            let phi = self.config.invariant.inputs(&points, &neighborhoods).unwrap();
            let edge = |i: usize, slot: usize| {
                let own = &phi.edges[(i * graph.k + slot) * phi.edge_dim..][..phi.edge_dim];
                let j = graph.row(i)[slot] as usize;
                let theirs = &phi.points[j * phi.point_dim..][..phi.point_dim];
                own.iter().chain(theirs).map(|v| f64::from(*v)).collect()
            };
            let edges: Vec<Rows> =
                (0..points.len()).map(|i| (0..graph.k).map(|slot| edge(i, slot)).collect()).collect();
            let invariant = self.branch("invariant", self.over_edges("invariant.embed", &edges), &graph);
            let (q, p) = (softmax(&global), softmax(&invariant));
            let m = q.len() as f64;
            let pose = p.iter().zip(&q).map(|(p, q)| m * p * (p / q).ln()).collect();
            (invariant, pose)
        };
        let mut head: Vec<f64> = pose.clone();
        for i in 0..=self.config.head.len() {
            let (weight, bias) =
                (self.tensor(&format!("head.{i}.weight")), self.tensor(&format!("head.{i}.bias")));
            let slope = f64::from(self.config.negative_slope);
            let out = bias.iter().enumerate().map(|(c, b)| {
                let y = b + head.iter().enumerate().map(|(k, v)| v * weight[k * bias.len() + c]).sum::<f64>();
                if y < 0.0 && i < self.config.head.len() { y * slope } else { y }
            });
            head = out.collect();
        }
        [global, invariant, pose, head]
    }
}

fn softmax(values: &[f64]) -> Vec<f64> {
    let sum: f64 = values.iter().map(|v| v.exp()).sum();
    values.iter().map(|v| v.exp() / sum).collect()
}

fn nearest(features: &Rows, k: usize) -> Graph {
    let k = k.min(features.len());
    let mut neighbors = Vec::new();
    for a in features {
        let distance_sq = |b: &Vec<f64>| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
        let mut order: Vec<u32> = (0..features.len() as u32).collect();
        order.sort_by(|&i, &j| {
            distance_sq(&features[i as usize]).total_cmp(&distance_sq(&features[j as usize]))
        });
        neighbors.extend(&order[..k]);
    }
    Graph { k, neighbors }
}

/// Largest difference from the plain network, relative to the largest value.
fn difference(file: &WeightsFile, config: &NetworkConfig, network: &Network, cloud: &[[f32; 3]]) -> f64 {
    let Representations { global, invariant, pose, head, .. } = network.representations(cloud).unwrap();
    let theirs = Plain { file, config }.representations(cloud);
    let mut worst = 0.0_f64;
    for (ours, theirs) in [global, invariant, pose, head].iter().zip(&theirs) {
        assert_eq!(ours.len(), theirs.len());
        let scale = theirs.iter().fold(1.0_f64, |scale, v| scale.max(v.abs()));
        for (a, b) in ours.iter().zip(theirs) {
            worst = worst.max((f64::from(*a) - b).abs() / scale);
        }
    }
    worst
}

fn assert_plain(config: &NetworkConfig, sizes: &[usize]) {
    let file = WeightsFile::random(config, 3);
    let network = Network::from_safetensors(&file.bytes(Precision::Single)).unwrap();
    for &n in sizes {
        let worst = difference(&file, config, &network, &surface(n, n as u64));
        assert!(worst < 1e-4, "{config:?} with {n} points: {worst}");
    }
}

#[test]
fn every_invariant_gives_the_plain_networks_numbers() {
    for invariant in INVARIANTS {
        let config =
            NetworkConfig { k: 7, widths: vec![12, 40, 72], head: vec![24], invariant, ..Default::default() };
        assert_plain(&config, &[150]);
    }
}

#[test]
fn clouds_of_every_size_give_the_plain_networks_numbers() {
    for graph in [GraphKind::Static, GraphKind::Dynamic] {
        let config = NetworkConfig {
            k: 9,
            widths: vec![16, 33],
            head: vec![],
            graph,
            negative_slope: 0.1,
            ..Default::default()
        };
        assert_plain(&config, &[1, 2, 5, 6, 7, 9, 10, 16, 17, 31, 64, 300]);
    }
}

#[test]
fn the_default_network_gives_the_plain_networks_numbers() {
    assert_plain(&NetworkConfig::default(), &[97]);
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let file = WeightsFile::random(&NetworkConfig::default(), 1);
    let network = Network::from_safetensors(&file.bytes(Precision::Single)).unwrap();
    let (source, target) = (surface(500, 1), surface(700, 2));
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| network.predict(&source, &target).unwrap())
    };
    let first = on(1);
    for threads in [1, 2, 3, 4] {
        assert_eq!(on(threads), first, "{threads} threads");
    }
}

#[test]
fn what_was_computed_before_changes_no_bit() {
    let config = NetworkConfig { widths: vec![16, 32], k: 8, ..Default::default() };
    let bytes = WeightsFile::random(&config, 1).bytes(Precision::Single);
    let network = Network::from_safetensors(&bytes).unwrap();
    let fresh = |n| Network::from_safetensors(&bytes).unwrap().representations(&surface(n, 4)).unwrap();
    for n in [100, 20, 333, 100, 1] {
        assert_eq!(network.representations(&surface(n, 4)).unwrap(), fresh(n), "{n} points");
    }
}
