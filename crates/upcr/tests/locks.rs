//! Locked degrees of freedom keep the first guess's values, and the free ones are found.

#![allow(clippy::unwrap_used)]

mod common;

use common::Pair;
use nalgebra::{Rotation3, Vector3};
use upcr::{Locks, Method, Rigid, Settings, register};

const LEVELLED: Locks = Locks { roll: true, pitch: true, yaw: false, x: false, y: false, z: true };

fn pose([roll, pitch, yaw]: [f64; 3], translation: [f64; 3]) -> Rigid {
    let rotation = Rotation3::from_euler_angles(roll, pitch, yaw).into_inner();
    Rigid { rotation, translation: translation.into() }
}

/// The sample pair in a place where `truth` is the true pose.
fn with_truth(truth: Rigid) -> Pair {
    let pair = Pair::sample(2);
    let moved = pair.with_source_moved(&(truth.inverse() * pair.truth));
    assert!(moved.error(&truth).within(1e-6, 1e-9));
    moved
}

/// A first guess with these angles that lays the source's centroid near its place; its z is the truth's.
fn near(pair: &Pair, angles: [f64; 3]) -> Rigid {
    let middle = common::centroid(&pair.source);
    let rotation = pose(angles, [0.0; 3]).rotation;
    let mut translation = pair.truth.rotation * middle + pair.truth.translation - rotation * middle;
    translation += Vector3::new(0.03, -0.03, 0.0) * pair.size();
    translation.z = pair.truth.translation.z;
    Rigid { rotation, translation }
}

fn bits(values: impl IntoIterator<Item = f64>) -> Vec<u64> {
    values.into_iter().map(f64::to_bits).collect()
}

#[track_caller]
fn assert_levelled(pair: &Pair, method: Method, init: Rigid) {
    let settings = Settings { method, init: Some(init), locks: LEVELLED, ..Settings::default() };
    let found = register(&pair.source, &pair.target, &settings).unwrap();
    let T = found.T_target_source;
    let error = pair.error(&T);
    assert!(error.within(1.0, 0.02 * pair.size()), "{method:?}: {error}");
    assert!(found.is_trustworthy(), "{method:?}: {:?}", found.reasons);
    assert_eq!(T.translation.z.to_bits(), init.translation.z.to_bits());
    // The third row of Rz(yaw) Ry(pitch) Rx(roll) is that of roll and pitch alone.
    assert!((T.rotation.row(2) - init.rotation.row(2)).amax() < 1e-15, "{}", T.rotation);
    assert!((T.rotation.transpose() * T.rotation - nalgebra::Matrix3::identity()).amax() < 1e-14);
    if init.rotation.row(2) == Vector3::z().transpose() {
        let (row, column) = (T.rotation.row(2), T.rotation.column(2));
        let one = bits([0.0, 0.0, 1.0]);
        // -0 counts as 0.
        assert_eq!(
            [bits(row.iter().map(|v| v + 0.0)), bits(column.iter().map(|v| v + 0.0))],
            [one.clone(), one]
        );
    }
}

#[test]
fn level_scans_turned_by_100_degrees() {
    let truth = pose([0.0, 0.0, 100_f64.to_radians()], [0.3, -0.2, 0.05]);
    let pair = with_truth(truth);
    assert_levelled(&pair, Method::Auto, Rigid::from_translation([0.0, 0.0, 0.05]));
    assert_levelled(&pair, Method::Prior, near(&pair, [0.0, 0.0, 94_f64.to_radians()]));
}

#[test]
fn axes_locked_at_an_angle() {
    let truth = pose([0.4, -0.3, 100_f64.to_radians()], [0.3, -0.2, 0.05]);
    let pair = with_truth(truth);
    assert_levelled(&pair, Method::Auto, pose([0.4, -0.3, 0.0], [0.0, 0.0, 0.05]));
    assert_levelled(&pair, Method::Prior, near(&pair, [0.4, -0.3, 94_f64.to_radians()]));
}

#[test]
fn nothing_free_is_the_first_guess() {
    let truth = pose([0.4, -0.3, 1.0], [0.3, -0.2, 0.05]);
    let pair = with_truth(truth);
    let locks = Locks { roll: true, pitch: true, yaw: true, x: true, y: true, z: true };
    for method in [Method::Prior, Method::Auto] {
        let settings = Settings { method, init: Some(truth), locks, ..Settings::default() };
        let found = register(&pair.source, &pair.target, &settings).unwrap();
        let T = found.T_target_source;
        assert_eq!(bits(T.translation.iter().copied()), bits(truth.translation.iter().copied()));
        assert!((T.rotation - truth.rotation).amax() < 1e-15);
        assert!(found.is_trustworthy(), "{method:?}: {:?}", found.reasons);
    }
}

/// A lock that contradicts the clouds is kept, and the verdict says what comes of it.
#[test]
fn a_wrong_lock_is_kept_and_not_trusted() {
    let pair = with_truth(pose([1.2, 0.0, 0.0], [0.0; 3]));
    let settings = Settings { locks: LEVELLED, ..Settings::default() };
    let found = register(&pair.source, &pair.target, &settings).unwrap();
    let row = found.T_target_source.rotation.row(2).into_owned();
    assert_eq!(bits(row.iter().map(|v| v + 0.0)), bits([0.0, 0.0, 1.0]));
    assert!(!found.is_trustworthy(), "probability {:.3}", found.probability);
}
