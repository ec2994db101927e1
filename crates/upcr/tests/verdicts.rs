//! What a verdict says of clouds that no pose, or more than one, explains.

#![allow(clippy::unwrap_used)]

mod common;

use common::{Pair, rotation, seeded};
use rand::Rng;
use upcr::{Method, PointCloud, Reason, Refinement, Registration, Settings, register};

/// Points on a square table of 1 × 1 × 0.7: its top and four legs, with a little noise.
fn square_table(seed: u64) -> PointCloud {
    let mut rng = seeded(seed);
    let mut points = Vec::new();
    for i in 0..4000 {
        let mut within = |a: f64, b: f64| rng.random_range(a..b);
        let p = if i % 2 == 0 {
            [within(-0.5, 0.5), within(-0.5, 0.5), 0.7]
        } else {
            let (x, y, z) = (within(-0.05, 0.05), within(-0.05, 0.05), within(0.0, 0.7));
            // One of the four faces of a leg, one of the four legs.
            let (x, y) = match i / 2 % 4 {
                0 => (x, 0.05),
                1 => (x, -0.05),
                2 => (0.05, y),
                _ => (-0.05, y),
            };
            let side = |bit: usize| if ((i / 8) >> bit) & 1 == 0 { 0.42 } else { -0.42 };
            [x + side(0), y + side(1), z]
        };
        points.push(p.map(|v| v + within(-0.003, 0.003)));
    }
    PointCloud::from_points(points)
}

fn found(source: &PointCloud, target: &PointCloud) -> Registration {
    register(source, target, &Settings::default()).unwrap()
}

#[test]
fn a_square_table_has_four_poses_and_says_so() {
    for seed in 0..3 {
        let motion = rotation(&mut seeded(seed));
        let found = found(&square_table(2 * seed), &square_table(2 * seed + 1).transformed(&motion));
        assert!(found.reasons.contains(&Reason::Ambiguous), "{found:?}");
        assert!(!found.is_trustworthy(), "{}", found.probability);
        // Relative to the true pose, all four are turns about the table's axis by a multiple of a right angle.
        let mut turns: Vec<f64> = std::iter::once(&found.T_target_source)
            .chain(found.alternatives.iter().map(|other| &other.T_target_source))
            .map(|pose| {
                let turn = motion.inverse() * *pose;
                assert!(turn.rotation[(2, 2)] > 0.999, "{turn:?}");
                turn.rotation[(1, 0)].atan2(turn.rotation[(0, 0)]).to_degrees().rem_euclid(360.0)
            })
            .collect();
        turns.sort_by(f64::total_cmp);
        let near =
            |angle: f64| turns.iter().any(|t| ((t - angle + 180.0).rem_euclid(360.0) - 180.0).abs() < 2.0);
        assert_eq!(turns.len(), 4, "{turns:?}");
        assert!([0.0, 90.0, 180.0, 270.0].into_iter().all(near), "{turns:?}");
        // Best first.
        assert!(found.alternatives.is_sorted_by(|a, b| a.relative_score >= b.relative_score));
    }
}

#[test]
fn millimetres_on_metres_are_told_with_the_factor() {
    let pair = Pair::sample(1);
    let millimetres =
        PointCloud::from_points(pair.source.points.iter().map(|p| p.map(|v| v * 1000.0)).collect());
    for (source, target, factor) in
        [(&millimetres, &pair.target, 0.001), (&pair.target, &millimetres, 1000.0)]
    {
        let found = found(source, target);
        assert!(found.reasons.contains(&Reason::ScaleMismatch), "{found:?}");
        assert!(!found.is_trustworthy());
        assert!((found.source_scale.unwrap() / factor - 1.0).abs() < 1e-9, "{:?}", found.source_scale);
    }
    // At one scale nothing of the kind is said.
    assert_eq!(found(&pair.source, &pair.target).source_scale, None);
}

#[test]
fn every_reason_comes_with_a_sentence_and_a_code() {
    let found = found(&square_table(0), &square_table(1));
    let json = serde_json::to_value(&found).unwrap();
    let codes: Vec<&str> = json["reasons"].as_array().unwrap().iter().map(|r| r.as_str().unwrap()).collect();
    assert!(codes.contains(&"ambiguous"), "{codes:?}");
    assert!(found.reasons.iter().all(|reason| reason.to_string().split(' ').count() > 4));
    assert_eq!(json["alternatives"].as_array().unwrap().len(), found.alternatives.len());
    assert!(json["evidence"]["rivals"].as_u64().unwrap() >= 1);
}

/// The floor before a wall across the view, `depth` ahead of a sensor that stands at the origin, 1.5 above the floor.
fn wall_ahead(depth: f64, seed: u64) -> PointCloud {
    let mut rng = seeded(seed);
    let mut point = || {
        let mut within = |a: f64, b: f64| rng.random_range(a..b);
        let noise = within(-0.005, 0.005);
        let (across, up) = (within(-0.6, 0.6), within(-0.45, 0.45));
        let floor = if up < 0.0 { 1.5 / -up } else { f64::INFINITY };
        let range = depth.min(floor) + noise;
        [across * range, up * range, range]
    };
    PointCloud::from_points((0..20_000).map(|_| point()).collect())
}

#[test]
fn a_wall_where_the_other_sensor_saw_through_is_told() {
    let (near, far) = (wall_ahead(4.0, 1), wall_ahead(7.0, 2));
    // Floor on floor, as whoever has no better guess may ask.
    let settings = Settings { method: Method::Prior, refine: Refinement::None, ..Settings::default() };
    let judged = |eye: Option<[f64; 3]>| {
        let far = PointCloud { viewpoint: eye, ..far.clone() };
        register(&near, &far, &settings).unwrap()
    };
    let (blind, seeing) = (judged(None), judged(Some([0.0; 3])));
    assert_eq!(blind.evidence.in_free_space, None);
    assert!(!blind.reasons.contains(&Reason::SeenThrough), "{:?}", blind.reasons);
    assert!(seeing.evidence.in_free_space.unwrap() > 0.3, "{:?}", seeing.evidence);
    assert!(seeing.reasons.contains(&Reason::SeenThrough), "{:?}", seeing.reasons);
    assert!(!seeing.is_trustworthy() && seeing.probability <= blind.probability);

    // Another scan of the same wall from the same place leaves the way free.
    let again = PointCloud { viewpoint: Some([0.0; 3]), ..wall_ahead(7.0, 3) };
    let found = register(&again, &PointCloud { viewpoint: Some([0.0; 3]), ..far }, &settings).unwrap();
    assert_eq!(found.evidence.in_free_space, Some(0.0));
}
