//! Pose graphs with what is known of them: made from a seed, or read from what `upcr merge --json` tells.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use nalgebra::{Matrix3, Matrix6, Rotation3, Vector3, Vector6};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;
use upcr::Rigid;
use upcr::multiway::{Edge, PoseGraph};

/// A room's edge, in scans a metre apart.
const ROOM: usize = 5;
/// Standard deviations of a pair's pose: radians and metres, each times a factor between a half and two.
const TURN: f64 = 0.004;
const SHIFT: f64 = 0.01;
/// An edge of a merge is wrong from here on: degrees and metres. The published poses are off by some centimetres themselves.
const WRONG: (f64, f64) = (15.0, 0.3);

/// A graph, and the truth where there is one.
pub struct Known {
    pub graph: PoseGraph,
    /// `T_world_scan`
    pub truth: Option<Vec<Rigid>>,
    /// Of each edge.
    pub right: Option<Vec<bool>>,
}

/// Where an error twist about `center` takes a pose.
pub fn moved(pose: &Rigid, twist: &Vector6<f64>, center: [f64; 3]) -> Rigid {
    let rotation = Rotation3::new(Vector3::new(twist[0], twist[1], twist[2])).into_inner();
    let (center, v) = (Vector3::from(center), Vector3::new(twist[3], twist[4], twist[5]));
    Rigid { rotation, translation: center + v - rotation * center } * *pose
}

fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (u, v) = (1.0 - rng.random::<f64>(), rng.random::<f64>());
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

fn rotation(rng: &mut ChaCha8Rng, most: f64) -> Matrix3<f64> {
    let axis = Vector3::from_fn(|_, _| normal(rng)).normalize();
    Rotation3::new(axis * most * rng.random::<f64>()).into_inner()
}

/// A square root of a pair's covariance.
fn uncertainty(rng: &mut ChaCha8Rng) -> Matrix6<f64> {
    let mut half = |size: f64| {
        let spread = Vector3::from_fn(|_, _| size * 4.0_f64.powf(rng.random::<f64>() - 0.5));
        rotation(rng, 3.0) * Matrix3::from_diagonal(&spread)
    };
    let (turn, shift) = (half(TURN), half(SHIFT));
    let mut root = Matrix6::zeros();
    root.fixed_view_mut::<3, 3>(0, 0).copy_from(&turn);
    root.fixed_view_mut::<3, 3>(3, 3).copy_from(&shift);
    // Rotations and translations of a pair's pose hang together.
    root.fixed_view_mut::<3, 3>(3, 0).copy_from(&Matrix3::from_fn(|_, _| 0.3 * SHIFT * normal(rng)));
    root
}

/// Scans in a grid of rooms with doors, each with edges to its neighbours, in any order and each in a frame of its own; of
/// all edges a share is wrong and as sure of itself as the others.
pub fn rooms(scans: usize, wrong: f64, seed: u64) -> Known {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let across = ((scans as f64).sqrt() / ROOM as f64).ceil() as usize * ROOM;
    let mut cells: Vec<[usize; 2]> = (0..scans).map(|i| [i % across, i / across]).collect();
    for i in (1..scans).rev() {
        cells.swap(i, rng.random_range(0..=i as u64) as usize);
    }
    let centers: Vec<[f64; 3]> = (0..scans).map(|_| [2.0, -1.0, 0.5].map(|v| v + normal(&mut rng))).collect();
    let truth: Vec<Rigid> = cells
        .iter()
        .zip(&centers)
        .map(|(cell, &center)| {
            let rotation = rotation(&mut rng, std::f64::consts::PI);
            let place = Vector3::new(cell[0] as f64, cell[1] as f64, 0.0)
                + Vector3::from_fn(|_, _| 0.1 * normal(&mut rng));
            Rigid { rotation, translation: place - rotation * Vector3::from(center) }
        })
        .collect();
    let at: BTreeMap<[usize; 2], usize> = cells.iter().enumerate().map(|(i, &cell)| (cell, i)).collect();
    // Within a room, or through the three places of a door.
    let sees = |a: [usize; 2], b: [usize; 2]| {
        let crossed: Vec<usize> = (0..2).filter(|&k| a[k] / ROOM != b[k] / ROOM).collect();
        let by_the_door = |k: usize| [a, b].iter().all(|cell| (cell[k] % ROOM).abs_diff(ROOM / 2) <= 1);
        match crossed[..] {
            [] => true,
            [k] => by_the_door(1 - k),
            _ => false,
        }
    };
    let mut pairs: Vec<[usize; 2]> = Vec::new();
    for (&cell, &i) in &at {
        for [dx, dy] in [[1, 0], [0, 1], [1, 1]] {
            pairs.extend(
                at.get(&[cell[0] + dx, cell[1] + dy])
                    .filter(|_| sees(cell, [cell[0] + dx, cell[1] + dy]))
                    .map(|&j| [i, j]),
            );
        }
        if cell[0] > 0 {
            let other = [cell[0] - 1, cell[1] + 1];
            pairs.extend(at.get(&other).filter(|_| sees(cell, other)).map(|&j| [i, j]));
        }
    }
    let mut edges: Vec<(Edge, bool)> = Vec::new();
    let mut edge = |rng: &mut ChaCha8Rng, [source, target]: [usize; 2], exact: Rigid, right: bool| {
        let root = uncertainty(rng);
        let off = root * Vector6::from_fn(|_, _| normal(rng));
        edges.push((
            Edge {
                source,
                target,
                T_target_source: moved(&exact, &off, centers[target]),
                covariance: root * root.transpose(),
                probability: 0.99,
            },
            right,
        ));
    };
    for &[i, j] in &pairs {
        let pair = if rng.random::<bool>() { [i, j] } else { [j, i] };
        edge(&mut rng, pair, truth[pair[1]].inverse() * truth[pair[0]], true);
    }
    let joined: BTreeSet<[usize; 2]> = pairs.iter().map(|&[i, j]| [i.min(j), i.max(j)]).collect();
    let most = (pairs.len() as f64 * wrong / (1.0 - wrong)).round() as usize;
    let mut count = 0;
    while count < most {
        let [i, j] = [(); 2].map(|()| rng.random_range(0..scans as u64) as usize);
        let apart = (0..2).map(|k| cells[i][k].abs_diff(cells[j][k])).max().unwrap_or(0);
        // One in two is with a scan nearby.
        if i == j || joined.contains(&[i.min(j), i.max(j)]) || (count % 2 == 0 && apart > 4) {
            continue;
        }
        // They seem to lie as neighbours do.
        let turn = rotation(&mut rng, std::f64::consts::PI);
        let shift = Vector3::from_fn(|_, _| 0.7 * normal(&mut rng));
        let lies = Rigid {
            rotation: turn,
            translation: Vector3::from(centers[j]) + shift - turn * Vector3::from(centers[i]),
        };
        edge(&mut rng, [i, j], lies, false);
        count += 1;
    }
    for i in (1..edges.len()).rev() {
        edges.swap(i, rng.random_range(0..=i as u64) as usize);
    }
    let (edges, right) = edges.into_iter().unzip();
    Known { graph: PoseGraph { centers, edges }, truth: Some(truth), right: Some(right) }
}

/// The graph of a merge: the best pose of each pair that is `least` probable. It tells no centres, so that of each scan is its
/// origin. With a folder of RedKitchen's poses, the truth too.
pub fn of_merge(path: &Path, least: f64, poses: Option<&Path>) -> Result<Known, String> {
    let text = std::fs::read_to_string(path).map_err(|e| format!("{}: {e}", path.display()))?;
    let told: Value = serde_json::from_str(&text).map_err(|e| format!("{}: {e}", path.display()))?;
    let missing = |what: &str| format!("{}: no {what}", path.display());
    // As the merge does: a quarter of a voxel that no covariance knows of, here at two metres.
    let length = 0.25 * told["voxel_size"].as_f64().ok_or_else(|| missing("voxel_size"))?;
    let angle = length / 2.0;
    let mut names: BTreeMap<&str, usize> = BTreeMap::new();
    let mut best: BTreeMap<[usize; 2], Edge> = BTreeMap::new();
    for pair in told["pairs"].as_array().ok_or_else(|| missing("pairs"))? {
        let number = |value: &Value| value.as_f64().ok_or_else(|| missing("number"));
        let probability = number(&pair["probability"])?;
        if probability < least {
            continue;
        }
        let mut scan = |key: &str| -> Result<usize, String> {
            let next = names.len();
            Ok(*names.entry(pair[key].as_str().ok_or_else(|| missing(key))?).or_insert(next))
        };
        let [source, target] = [scan("source_name")?, scan("target_name")?];
        let mut rows = [[0.0; 4]; 4];
        let mut covariance = Matrix6::zeros();
        for r in 0..6 {
            for c in 0..6 {
                covariance[(r, c)] = number(&pair["covariance"][r][c])?;
                if r < 4 && c < 4 {
                    rows[r][c] = number(&pair["T_target_source"][r][c])?;
                }
            }
            covariance[(r, r)] += if r < 3 { angle * angle } else { length * length };
        }
        let edge =
            Edge { source, target, T_target_source: Rigid::from_rows(&rows)?, covariance, probability };
        let held = best.entry([source, target]).or_insert_with(|| edge.clone());
        if probability > held.probability {
            *held = edge;
        }
    }
    let edges: Vec<Edge> = best.into_values().collect();
    let mut truth = None;
    if let Some(folder) = poses {
        let mut found = vec![Rigid::identity(); names.len()];
        for (name, &scan) in &names {
            let file = folder.join(name.replace(".depth.png", ".pose.txt"));
            found[scan] = upcr::io::read_transform(&file).map_err(|e| e.to_string())?;
        }
        truth = Some(found);
    }
    let right = truth.as_ref().map(|truth| {
        edges
            .iter()
            .map(|e| {
                let off = truth[e.target].inverse() * truth[e.source] * e.T_target_source.inverse();
                off.angle().to_degrees() < WRONG.0 && off.translation.norm() < WRONG.1
            })
            .collect()
    });
    let graph = PoseGraph { centers: vec![[0.0; 3]; names.len()], edges };
    Ok(Known { graph, truth, right })
}
