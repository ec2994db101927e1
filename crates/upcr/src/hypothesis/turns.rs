//! Poses that would be as right if the cloud were symmetric: it turned about its principal axes.
//!
//! A source of hypotheses may have one answer; whether a nearly symmetric shape has a better one, or another as good,
//! only a comparison tells.

use nalgebra::{Rotation3, Unit};

use crate::{
    cloud::{mean, principal_axes},
    prepare::Level,
    transform::Rigid,
};

/// Turns about each principal axis.
const TURNS: u32 = 12;
/// Points that tell the axes.
const POINTS: usize = 512;

/// `pose` after every turn of the source about one of its principal axes.
pub(crate) fn turned(source: &Level, pose: &Rigid) -> Vec<Rigid> {
    let points: Vec<[f32; 3]> = source.spread(POINTS).iter().map(|&i| source.points[i as usize]).collect();
    turns(&points).map(|turn| *pose * turn).collect()
}

/// Turns of the points about their principal axes.
fn turns(points: &[[f32; 3]]) -> impl Iterator<Item = Rigid> {
    let points = points.iter().map(|p| p.map(f64::from));
    let (mean, axes) = (mean(points.clone()), principal_axes(points).eigenvectors);
    (0..3).flat_map(move |axis| {
        let axis = Unit::new_normalize(axes.column(axis).into_owned());
        (1..TURNS).map(move |step| {
            let angle = std::f64::consts::TAU * f64::from(step) / f64::from(TURNS);
            let rotation = Rotation3::from_axis_angle(&axis, angle).into_inner();
            Rigid { rotation, translation: mean - rotation * mean }
        })
    })
}
