//! The forward pass of a trained network.

use std::path::Path;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use nalgebra::Vector3;

use super::graph::PairedRows;
use super::head::Head;
use super::layer::{Embedding, Features, GraphLayer, Products};
use super::pool::{PoolRoom, PooledLayer};
use super::search::{SearchRoom, nearest, nearest_features};
use super::weights::Weights;
use super::{Graph, GraphKind, Invariant, InvariantInputs, NetworkConfig};
use crate::error::{CloudRole, Error, Result};
use crate::neighbors::KdTree;
use crate::transform::Rigid;

/// The weights file of the network that is part of the library ([`Network::embedded`]).
pub static EMBEDDED_WEIGHTS: &[u8] = include_bytes!("../../weights/upcr.safetensors");

/// A trained UPCR network, packed for inference.
#[derive(Debug, Clone)]
pub struct Network {
    config: NetworkConfig,
    trained: bool,
    fingerprint: u64,
    global: Branch,
    invariant: Option<InvariantBranch>,
    head: Head,
    rooms: Rooms,
}

/// Networks of the same weights are equal.
impl PartialEq for Network {
    fn eq(&self, other: &Self) -> bool {
        self.fingerprint == other.fingerprint
    }
}

/// The branch that sees φ alone.
#[derive(Debug, Clone)]
struct InvariantBranch {
    embedding: Embedding,
    branch: Branch,
}

/// Graph layers; of the last only the maximum over all points is wanted.
#[derive(Debug, Clone)]
struct Branch {
    layers: Vec<GraphLayer>,
    last: PooledLayer,
}

/// What a network makes of one cloud.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Representations {
    /// Mean of the points.
    pub centroid: [f64; 3],
    /// Γg, of positions.
    pub global: Vec<f32>,
    /// Γν, of what no motion changes; Γg where the network has no such branch.
    pub invariant: Vec<f32>,
    /// Γμ, what remains of the first without the second (section II-A).
    pub pose: Vec<f32>,
    /// What the pose head reads from it: values of a rotation, then three of a translation.
    pub head: Vec<f32>,
}

impl Network {
    /// From a weights file's bytes.
    ///
    /// # Errors
    /// [`Error::InvalidWeights`] where they are no weights file, or a tensor is missing, of another shape or type, or
    /// not finite; [`Error::InvalidSetting`] where the configuration is out of its range.
    pub fn from_safetensors(bytes: &[u8]) -> Result<Self> {
        let weights = Weights::open(bytes)?;
        let config = weights.config.clone();
        let slope = config.negative_slope;
        let branch = |name: &str, inputs: usize| {
            let inputs = std::iter::once(inputs).chain(config.widths.iter().copied());
            let map = |(l, (inputs, &outputs))| weights.edge_map(&format!("{name}.{l}"), 2 * inputs, outputs);
            let maps = inputs.zip(&config.widths).enumerate().map(map).collect::<Result<Vec<_>>>()?;
            let Some((last, maps)) = maps.split_last() else {
                return Err(Error::InvalidWeights { reason: "no graph layer".into() });
            };
            let layers = maps.iter().map(|map| GraphLayer::new(map, slope)).collect();
            Ok(Branch { layers, last: PooledLayer::new(last, slope) })
        };
        let global = branch("global", 3)?;
        let mut invariant = None;
        if config.invariant != Invariant::None {
            let (edge_dim, point_dim) = (config.invariant.edge_dim(), config.invariant.point_dim());
            let map = weights.edge_map("invariant.embed", edge_dim + point_dim, config.widths[0])?;
            let embedding = Embedding::new(&map, edge_dim, slope);
            invariant = Some(InvariantBranch { embedding, branch: branch("invariant", config.widths[0])? });
        }
        let values = config.rotation.values() + 3;
        let inputs = std::iter::once(config.representation()).chain(config.head.iter().copied());
        let outputs = config.head.iter().copied().chain(std::iter::once(values));
        let head = inputs.zip(outputs).enumerate();
        let head = head.map(|(i, (inputs, outputs))| weights.linear(&format!("head.{i}"), inputs, outputs));
        let head = Head::new(head.collect::<Result<Vec<_>>>()?, slope, config.rotation);
        let fingerprint = crate::hash::fnv1a(bytes);
        Ok(Self {
            trained: weights.trained,
            fingerprint,
            config,
            global,
            invariant,
            head,
            rooms: Rooms::default(),
        })
    }

    /// From a weights file.
    ///
    /// # Errors
    /// [`Error::Io`] where it cannot be read; otherwise as [`Self::from_safetensors`], [`Error::Malformed`] in place of
    /// [`Error::InvalidWeights`].
    pub fn load(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).map_err(|source| Error::Io { path: path.into(), source })?;
        Self::from_safetensors(&bytes).map_err(|error| match error {
            Error::InvalidWeights { reason } => {
                Error::Malformed { path: path.into(), format: "weights", reason }
            }
            other => other,
        })
    }

    /// The network that is part of the library, trained on shapes (docs/network.md).
    ///
    /// # Errors
    /// None; it has the type of the other ways to a network.
    pub fn embedded() -> Result<Arc<Self>> {
        static NETWORK: OnceLock<Arc<Network>> = OnceLock::new();
        if let Some(network) = NETWORK.get() {
            return Ok(network.clone());
        }
        let network = Arc::new(Self::from_safetensors(EMBEDDED_WEIGHTS)?);
        Ok(NETWORK.get_or_init(|| network).clone())
    }

    /// A number that tells weights apart.
    pub fn fingerprint(&self) -> u64 {
        self.fingerprint
    }

    /// What the network is made of.
    pub fn config(&self) -> &NetworkConfig {
        &self.config
    }

    /// Whether its weights were trained; random ones say so in their file.
    pub fn is_trained(&self) -> bool {
        self.trained
    }

    /// The pose that lays `source` on `target`, the two clouds and their branches in parallel. The clouds are
    /// meant to be as in training: of that scale, and not much denser.
    ///
    /// # Errors
    /// Where a cloud is empty or holds a coordinate that is not finite.
    pub fn predict(&self, source: &[[f32; 3]], target: &[[f32; 3]]) -> Result<Rigid> {
        let pose = |cloud, role| self.pose(cloud, role, self.config.k);
        let (source, target) =
            rayon::join(|| pose(source, CloudRole::Source), || pose(target, CloudRole::Target));
        Ok(target? * source?.inverse())
    }

    /// The pose of a cloud about the latent canonical shape, the two branches in parallel: that of a target times the
    /// inverse of that of a source is what [`Self::predict`] gives. A cloud with fewer points than those of training is
    /// best seen with fewer neighbours `k`, that reach as far.
    ///
    /// # Errors
    /// Where the cloud is empty or holds a coordinate that is not finite.
    pub fn canonical_pose(&self, cloud: &[[f32; 3]], k: usize) -> Result<Rigid> {
        self.pose(cloud, CloudRole::Cloud, k.max(1))
    }

    /// Every cloud's representations.
    ///
    /// # Errors
    /// Where the cloud is empty or holds a coordinate that is not finite.
    pub fn representations(&self, cloud: &[[f32; 3]]) -> Result<Representations> {
        self.rooms.with(|room| {
            self.run(cloud, CloudRole::Cloud, self.config.k, room)?;
            Ok(room.representations.clone())
        })
    }

    /// What the second branch starts from: φ over the edges of the cloud, with the neighbours that these lead to.
    ///
    /// # Errors
    /// Where the cloud is empty or holds a coordinate that is not finite.
    pub fn features(&self, cloud: &[[f32; 3]]) -> Result<InvariantInputs> {
        check(cloud, CloudRole::Cloud)?;
        self.rooms.with(|room| {
            self.prepare(cloud, self.config.k, room)?;
            Ok(room.inputs.clone())
        })
    }

    fn pose(&self, cloud: &[[f32; 3]], role: CloudRole, k: usize) -> Result<Rigid> {
        self.rooms.with(|room| {
            self.run(cloud, role, k, room)?;
            let Representations { centroid, head, .. } = &room.representations;
            let about_centroid = self.head.pose(head);
            let translation = Vector3::from(*centroid) + about_centroid.translation;
            Ok(Rigid { translation, ..about_centroid })
        })
    }

    /// Fills the room's representations.
    fn run(&self, cloud: &[[f32; 3]], role: CloudRole, k: usize, room: &mut Room) -> Result<()> {
        check(cloud, role)?;
        self.prepare(cloud, k, room)?;
        let Room { representations, points, order, neighbors, inputs, global, invariant, values, .. } = room;
        let (global_gamma, invariant_gamma) = (&mut representations.global, &mut representations.invariant);
        rayon::join(
            || {
                global.features.copy_from(points.as_flattened(), 3);
                self.branch(&self.global, 3, neighbors, order, global, global_gamma);
            },
            || {
                if let Some(InvariantBranch { embedding, branch }) = &self.invariant {
                    let BranchRoom { features, next, products, .. } = invariant;
                    embedding.apply(inputs, &neighbors.graph, next, products, features);
                    let channels = self.config.widths[0];
                    self.branch(branch, channels, neighbors, order, invariant, invariant_gamma);
                }
            },
        );
        self.separate(representations);
        self.head.apply(&representations.pose, &mut representations.head, values);
        Ok(())
    }

    /// Moves the cloud to its centroid and finds neighbours and φ.
    fn prepare(&self, cloud: &[[f32; 3]], k: usize, room: &mut Room) -> Result<()> {
        let Room { representations, points, order, neighbors, inputs, search, .. } = room;
        let Neighbors { graph, rows } = neighbors;
        representations.centroid = centered(cloud, points).map(f64::from);
        match self.config.invariant {
            Invariant::None => nearest(points, k, order, graph, search),
            Invariant::Distance => {
                nearest(points, k, order, graph, search);
                distances(points, graph, inputs);
            }
            other => {
                let neighborhoods = KdTree::new(points).knn_graph(k);
                *inputs = other.inputs(points, &neighborhoods)?;
                *graph = Graph::from(&neighborhoods);
                order.clear();
                order.extend(0..points.len() as u32);
            }
        }
        rows.fill(graph);
        Ok(())
    }

    /// A branch's representation from the features that lie ready in `room`.
    fn branch(
        &self,
        branch: &Branch,
        mut channels: usize,
        neighbors: &Neighbors,
        order: &[u32],
        room: &mut BranchRoom,
        gamma: &mut Vec<f32>,
    ) {
        let BranchRoom { features, next, products, pool, own, search } = room;
        for (layer, &outputs) in branch.layers.iter().zip(&self.config.widths) {
            let Neighbors { graph, rows } = self.neighbors(features, channels, neighbors, order, own, search);
            layer.apply(features, graph.len(), rows, products, next);
            std::mem::swap(features, next);
            channels = outputs;
        }
        let Neighbors { graph, rows } = self.neighbors(features, channels, neighbors, order, own, search);
        branch.last.apply(features, graph, rows, pool, gamma);
    }

    /// The neighbours of a layer: `by_position`, or `own`, filled with those by the layer's features.
    fn neighbors<'a>(
        &self,
        features: &Features,
        channels: usize,
        by_position: &'a Neighbors,
        order: &[u32],
        own: &'a mut Neighbors,
        search: &mut SearchRoom,
    ) -> &'a Neighbors {
        match self.config.graph {
            GraphKind::Static => by_position,
            GraphKind::Dynamic => {
                nearest_features(features, channels, by_position.graph.k, order, &mut own.graph, search);
                own.rows.fill(&own.graph);
                own
            }
        }
    }

    /// Γμ = m·p·log(p/q) with q = softmax(Γg), p = softmax(Γν) (section II-A).
    fn separate(&self, r: &mut Representations) {
        r.pose.clear();
        if self.invariant.is_none() {
            r.invariant.clone_from(&r.global);
            r.pose.extend_from_slice(&r.global);
            return;
        }
        let (log_q, log_p) = (log_normalizer(&r.global), log_normalizer(&r.invariant));
        let m = r.global.len() as f32;
        r.pose.extend(r.global.iter().zip(&r.invariant).map(|(g, v)| {
            let (log_q, log_p) = (g - log_q, v - log_p);
            m * log_p.exp() * (log_p - log_q)
        }));
    }
}

/// log Σ exp
fn log_normalizer(values: &[f32]) -> f32 {
    let most = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    most + values.iter().map(|v| (v - most).exp()).sum::<f32>().ln()
}

fn check(cloud: &[[f32; 3]], role: CloudRole) -> Result<()> {
    if cloud.is_empty() {
        return Err(Error::TooFewPoints { role, found: 0, needed: 1 });
    }
    let finite = |p: &[f32; 3]| p.iter().all(|v| v.is_finite());
    match cloud.iter().position(|p| !finite(p)) {
        Some(first) => {
            Err(Error::NonFinite { role, count: cloud.iter().filter(|p| !finite(p)).count(), first })
        }
        None => Ok(()),
    }
}

/// Fills `points` with the cloud about its centroid, which is returned. Learning and use centre clouds alike to the last
/// bit: where a surface is flat, the sign of a normal turns on it, and with the normal the histograms.
pub fn centered(cloud: &[[f32; 3]], points: &mut Vec<[f32; 3]>) -> [f32; 3] {
    let sum = cloud.iter().fold([0.0; 3], |sum, p| [0, 1, 2].map(|a| sum[a] + f64::from(p[a])));
    let centroid = sum.map(|s| (s / cloud.len() as f64) as f32);
    points.clear();
    points.extend(cloud.iter().map(|p| [0, 1, 2].map(|a| p[a] - centroid[a])));
    centroid
}

/// φ of [`Invariant::Distance`] for points about their centroid, over rows in any order.
fn distances(points: &[[f32; 3]], graph: &Graph, inputs: &mut InvariantInputs) {
    let length = |v: [f32; 3]| (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    inputs.edge_dim = 3;
    inputs.edges.clear();
    for (&center, row) in points.iter().zip(graph.rows()) {
        let to_center = length(center);
        inputs.edges.extend(row.iter().flat_map(|&j| {
            let neighbor = points[j as usize];
            let between = [0, 1, 2].map(|a| neighbor[a] - center[a]);
            [length(neighbor), length(between), to_center]
        }));
    }
}

/// What the pass of one cloud needs room for.
#[derive(Debug, Default)]
struct Room {
    /// Points about the centroid, near ones near each other, and the order that they came in.
    points: Vec<[f32; 3]>,
    order: Vec<u32>,
    neighbors: Neighbors,
    search: SearchRoom,
    inputs: InvariantInputs,
    global: BranchRoom,
    invariant: BranchRoom,
    representations: Representations,
    values: Vec<f32>,
}

/// A graph, and its rows as layers look at them.
#[derive(Debug, Default)]
struct Neighbors {
    graph: Graph,
    rows: PairedRows,
}

/// What a branch needs room for.
#[derive(Debug, Default)]
struct BranchRoom {
    features: Features,
    next: Features,
    products: Products,
    pool: PoolRoom,
    own: Neighbors,
    search: SearchRoom,
}

/// Rooms that passes leave for later ones, so that no memory is allocated once as many are there as run at a time.
#[derive(Debug, Clone, Default)]
struct Rooms(Arc<Mutex<Vec<Room>>>);

impl Rooms {
    fn with<T>(&self, work: impl FnOnce(&mut Room) -> T) -> T {
        let mut room = self.0.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default();
        let result = work(&mut room);
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(room);
        result
    }
}
