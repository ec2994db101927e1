//! Covariances hold the true pose as often as they say, and free motions are named. More of both, on public shapes, is
//! measured by `upcr calibrate test`.

#![allow(clippy::unwrap_used)]

use upcr::Settings;
use upcr_lab::data::{Shapes, scanner::scenes};
use upcr_lab::trust::{covariance, free_axes};

/// Statues of the virtual scanner's, 2048 points each, in the unit sphere.
fn statues(count: u64) -> Shapes {
    let cloud = |seed: u64| {
        let points = scenes::object(seed).sample(2048, seed).points;
        // A statue stands on the origin, 0.2 high.
        points.iter().map(|p| [p[0], p[1], p[2] - 0.1].map(|v| (v / 0.15) as f32)).collect()
    };
    Shapes {
        clouds: (0..count).map(cloud).collect(),
        labels: vec![0; count as usize],
        names: vec!["statue".into()],
    }
}

#[test]
fn covariances_hold_the_true_pose() {
    let found = covariance::measure(&statues(10), 60, 3, &Settings::default()).unwrap();
    let all = found[0];
    assert!(all.pairs == 60 && all.right > 45, "{found:?}");
    // Chance alone takes 50 pairs of 0.95 each below 0.85 three times in a thousand.
    assert!(all.share.unwrap() > 0.85 && (2.5..8.0).contains(&all.mean_nees.unwrap()), "{found:?}");
}

#[test]
fn free_motions_are_named() {
    for found in free_axes::measure(5, 7, &Settings::default()).unwrap() {
        assert_eq!(found.named, found.pairs, "{found:?}");
    }
}
