//! Many scans into models: a landscape seen in tiles, and the Stanford bunny.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod common;

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use common::{between, centroid, data, normal, rotation, seeded, sheet};
use nalgebra::{Matrix6, Vector3};
use upcr::multiway::{Attempt, Edge, MergeSettings, MergeWatch, Merged, Place, Scans, merge};
use upcr::{Error, PointCloud, Result, Rigid, Settings, io};

/// Scans that count how often they are read.
struct Counted {
    scans: Vec<PointCloud>,
    reads: AtomicUsize,
}

impl Scans for Counted {
    fn len(&self) -> usize {
        self.scans.len()
    }

    fn read(&self, scan: usize) -> Result<PointCloud> {
        self.reads.fetch_add(1, Ordering::Relaxed);
        Ok(self.scans[scan].clone())
    }
}

/// Tiles of a landscape that overlap by half, each in a frame of its own; with their true poses.
fn tiles() -> (Vec<PointCloud>, Vec<Rigid>) {
    const EDGE: f64 = 4.0;
    let mut rng = seeded(11);
    let waves: Vec<[f64; 4]> = (0..14)
        .map(|k| {
            [
                0.9 * normal(&mut rng),
                0.9 * normal(&mut rng),
                normal(&mut rng),
                0.5 / (1.0 + 0.2 * f64::from(k)),
            ]
        })
        .collect();
    let height = |x: f64, y: f64| -> f64 {
        waves.iter().map(|[a, b, c, size]| size * (2.0 * a * x + 2.0 * b * y + 3.0 * c).sin()).sum()
    };
    let (mut scans, mut truth) = (Vec::new(), Vec::new());
    for row in 0..3 {
        for column in 0..3 {
            let [x0, y0] = [column, row].map(|n| f64::from(n) * EDGE / 2.0);
            // Sampled anew each time.
            let [du, dv] = [0.3 * normal(&mut rng), 0.3 * normal(&mut rng)];
            let tile = sheet(70, EDGE, |u, v| {
                let (x, y) = (x0 + EDGE * u, y0 + EDGE * v);
                height(x, y) / EDGE
            });
            let jitter = |v: f64| v + 0.004 * (du + dv);
            let points = tile.points.iter().map(|&[x, y, z]| [jitter(x), jitter(y), z]).collect();
            let place = Rigid::from_translation([x0, y0, 0.0]);
            let own =
                Rigid { translation: Vector3::new(3.0, -8.0, 1.0) * f64::from(row), ..rotation(&mut rng) };
            scans.push(PointCloud::from_points(points).transformed(&own));
            truth.push(place * own.inverse());
        }
    }
    (scans, truth)
}

fn merged(scans: &[PointCloud], settings: &MergeSettings) -> Merged {
    merge(scans, settings, &[], &MergeWatch::default()).unwrap()
}

fn pose(place: &Place) -> Option<(usize, Rigid)> {
    match place {
        Place::Placed { model, T_model_scan, .. } => Some((*model, *T_model_scan)),
        _ => None,
    }
}

/// Asserts that the scans lie in one model as they should, up to the common frame.
fn assert_poses(scans: &[PointCloud], found: &Merged, truth: &[Rigid], degrees: f64, length: f64) {
    let poses: Vec<Rigid> = found.places[..truth.len()]
        .iter()
        .map(|place| {
            let (model, pose) = pose(place).unwrap_or_else(|| panic!("{place:?}"));
            assert_eq!(model, 0);
            pose
        })
        .collect();
    // The frame of the scan that suits the others best.
    let worst = (0..truth.len())
        .map(|anchor| {
            let to_truth = truth[anchor] * poses[anchor].inverse();
            let off = |i: usize| between(&(to_truth * poses[i]), &truth[i], centroid(&scans[i]));
            let all: Vec<_> = (0..truth.len()).map(off).collect();
            (
                all.iter().map(|e| e.degrees).fold(0.0, f64::max),
                all.iter().map(|e| e.centroid).fold(0.0, f64::max),
            )
        })
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .unwrap();
    assert!(worst.0 < degrees && worst.1 < length, "{worst:?}");
}

#[test]
fn tiles_come_together_whatever_the_threads_and_the_memory() {
    let (scans, truth) = tiles();
    let settings = |threads: usize, max_memory_bytes| MergeSettings {
        registration: Settings { threads: threads.try_into().ok(), ..Settings::default() },
        max_memory_bytes,
        ..MergeSettings::default()
    };
    let found = merged(&scans, &settings(1, None));
    assert_poses(&scans, &found, &truth, 1.0, 0.1);
    assert_eq!(found, merged(&scans, &settings(3, None)));

    // With room for two scans each is read many times, and the poses are the same.
    let counted = Counted { scans: scans.clone(), reads: AtomicUsize::new(0) };
    let frugal = merge(&counted, &settings(2, Some(1)), &[], &MergeWatch::default()).unwrap();
    assert_eq!(frugal, found);
    assert!(counted.reads.into_inner() > 3 * scans.len());
}

#[test]
fn what_is_known_is_not_looked_for_again() {
    let (scans, _) = tiles();
    let told = Mutex::new(Vec::new());
    let hear = |attempt: &Attempt| {
        told.lock().unwrap().push(attempt.clone());
        Ok(())
    };
    let whole = merge(
        &scans[..],
        &MergeSettings::default(),
        &[],
        &MergeWatch { pair: &hear, ..MergeWatch::default() },
    )
    .unwrap();
    let told = told.into_inner().unwrap();

    // Stopped in the middle, and gone on with.
    let heard = AtomicUsize::new(0);
    let full = |_: &Attempt| match heard.fetch_add(1, Ordering::Relaxed) {
        7 => Err(Error::Io { path: "full".into(), source: std::io::ErrorKind::StorageFull.into() }),
        _ => Ok(()),
    };
    let stopped = merge(
        &scans[..],
        &MergeSettings::default(),
        &[],
        &MergeWatch { pair: &full, ..MergeWatch::default() },
    );
    assert!(matches!(stopped, Err(Error::Io { .. })));
    let again = AtomicUsize::new(0);
    let count = |_: &Attempt| {
        again.fetch_add(1, Ordering::Relaxed);
        Ok(())
    };
    let gone_on = merge(
        &scans[..],
        &MergeSettings::default(),
        &told[..7],
        &MergeWatch { pair: &count, ..MergeWatch::default() },
    )
    .unwrap();
    assert_eq!(gone_on, whole);
    assert_eq!(again.into_inner(), told.len() - 7);
}

#[test]
fn scans_of_no_use_are_named_and_the_rest_is_merged() {
    let (mut scans, truth) = tiles();
    scans.push(PointCloud::from_points(vec![[0.0; 3]; 5]));
    // Another landscape.
    scans.push(sheet(70, 4.0, |u, v| 0.1 * (9.0 * u * u).sin() + 0.2 * (6.0 * v).cos() * u));
    let found = merged(&scans, &MergeSettings::default());
    assert_poses(&scans, &found, &truth, 1.0, 0.1);
    assert!(
        matches!(&found.places[9], Place::Unusable { reason } if reason.contains("equal")),
        "{:?}",
        found.places[9]
    );
    assert_eq!(found.places[10], Place::Alone);
    assert!(merged(&[], &MergeSettings::default()).places.is_empty());
}

/// Ten range scans, shuffled and turned anyhow, and their published poses.
fn bunny() -> Option<(Vec<PointCloud>, Vec<Rigid>)> {
    let folder = data("stanford_bunny")?;
    let names =
        ["ear_back", "chin", "bun045", "bun180", "bun090", "bun270", "bun000", "top3", "bun315", "top2"];
    let mut rng = seeded(3);
    let scans = names.map(|name| {
        let own = Rigid { translation: Vector3::new(0.2, -0.1, 0.3), ..rotation(&mut rng) };
        let cloud = io::read_cloud(folder.join(format!("{name}.ply"))).unwrap();
        let pose = io::read_transform(folder.join(format!("{name}.pose.txt"))).unwrap();
        (cloud.transformed(&own), pose * own.inverse())
    });
    Some(scans.into_iter().unzip())
}

#[test]
fn ten_scans_of_the_bunny_come_together() {
    let Some((scans, truth)) = bunny() else { return };
    let found = merged(&scans, &MergeSettings::default());
    assert_poses(&scans, &found, &truth, 1.0, 1.5e-3);
    for pair in found.pairs.iter().filter(|pair| pair.kept) {
        let (a, b) = (pair.attempt.source, pair.attempt.target);
        let error = between(
            &Rigid::from_rows(&pair.attempt.T_target_source).unwrap(),
            &(truth[b].inverse() * truth[a]),
            centroid(&scans[a]),
        );
        assert!(error.within(5.0, 0.02), "{a} {b}: {error}");
    }
}

#[test]
fn wrong_pairs_and_a_foreign_scan_change_nothing() {
    let Some((mut scans, truth)) = bunny() else { return };
    let mut graph = merged(&scans, &MergeSettings::default()).graph;
    let before = graph.solve();

    // A fifth more pairs, wrong by anything, and sure of themselves.
    let mut rng = seeded(8);
    let right = graph.edges.len();
    for k in 0..right.div_ceil(5) {
        let edge = graph.edges[(7 * k) % right].clone();
        let center = Rigid::from_translation(graph.centers[edge.target]);
        let off = 0.05 * Vector3::new(normal(&mut rng), normal(&mut rng), normal(&mut rng));
        let wrong = center * Rigid { translation: off, ..rotation(&mut rng) } * center.inverse();
        let T_target_source = wrong * edge.T_target_source;
        graph.edges.push(Edge {
            T_target_source,
            covariance: Matrix6::identity() * 1e-7,
            probability: 0.99,
            ..edge
        });
    }
    let after = graph.solve();
    assert!(after.edges[right..].iter().all(|edge| !edge.kept));
    let frame = |poses: &[Rigid]| poses[0].inverse();
    for (i, scan) in scans.iter().enumerate() {
        let [a, b] = [&before, &after].map(|solution| frame(&solution.poses) * solution.poses[i]);
        let error = between(&a, &b, centroid(scan));
        assert!(error.within(0.5, 1e-3), "{error}");
    }

    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../samples");
    scans.push(io::read_cloud(folder.join("source.ply")).unwrap());
    let found = merged(&scans, &MergeSettings::default());
    assert_eq!(found.places[10], Place::Alone);
    assert_poses(&scans, &found, &truth, 1.0, 1.5e-3);
}
