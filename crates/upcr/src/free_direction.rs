//! Motions that the geometry leaves free, by name.

use nalgebra::{Matrix3, Matrix6xX, Vector3, Vector6};
use serde::Serialize;

/// A motion of the registered source that leaves its surface on the target's. Coordinates are those of the target's
/// file.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(tag = "motion", rename_all = "snake_case")]
pub enum FreeDirection {
    /// Any slide along an axis.
    Translation {
        /// Unit vector.
        axis: [f64; 3],
    },
    /// Any turn about an axis through a point.
    Rotation {
        /// Unit vector.
        axis: [f64; 3],
        /// A point on the axis: where the axes of several meet, and of these points the one nearest to the centre of
        /// the target's bounding box.
        point: [f64; 3],
    },
}

impl std::fmt::Display for FreeDirection {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let vector = |v: &[f64; 3], digits: usize| {
            // No minus before a zero.
            let zero = 0.5 * 0.1_f64.powi(digits as i32);
            let [x, y, z] = v.map(|v| if v.abs() < zero { 0.0 } else { v });
            format!("({x:.digits$}, {y:.digits$}, {z:.digits$})")
        };
        match self {
            Self::Translation { axis } => {
                write!(f, "the pose is free to slide along {}", vector(axis, 4))
            }
            Self::Rotation { axis, point } => {
                write!(f, "the pose is free to turn about {} through {}", vector(axis, 4), vector(point, 6))
            }
        }
    }
}

type V = Vector3<f64>;

/// An axis this many radii away is one at infinity: turning about it is sliding.
const FAR_RADII: f64 = 5.0;
/// Axes this near to parallel (squared sine) meet nowhere.
const SHARP: f64 = 1e-6;

/// Splits a space of free motions into translations and rotations.
///
/// `free`: orthonormal columns, twists (rotation, translation) about `origin` with rotations in units of 1/`radius`.
pub(crate) fn name(free: &Matrix6xX<f64>, radius: f64, origin: [f64; 3]) -> Vec<FreeDirection> {
    if free.ncols() == 0 {
        return Vec::new();
    }
    // Combinations of the columns by how much they turn, from those that do not.
    let turns = free.rows(0, 3);
    let eigen = (turns.transpose() * turns).symmetric_eigen();
    let mut combinations: Vec<(f64, Vector6<f64>)> =
        eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()).map(|(t, c)| (*t, free * c)).collect();
    combinations.sort_by(|a, b| a.0.total_cmp(&b.0));
    let slides = combinations.partition_point(|(turn_sq, _)| *turn_sq < 1.0 / (1.0 + FAR_RADII * FAR_RADII));
    let (slides, turns) = combinations.split_at(slides);
    let part = |twist: &Vector6<f64>, first: usize| -> Vector3<f64> { twist.fixed_rows::<3>(first).into() };
    let slides: Vec<V> = slides.iter().filter_map(|(_, twist)| part(twist, 3).try_normalize(0.0)).collect();

    // Of a turn's translation what no slide explains is c × ω, c being on the axis: the least of all c that solve this
    // for every turn, as axes that do not meet in one point leave it free along them.
    let mut axes = Vec::new();
    let (mut squares, mut moments) = (Matrix3::zeros(), V::zeros());
    for (_, twist) in turns {
        let (turn, shift) = (part(twist, 0), part(twist, 3));
        let explained: V = slides.iter().map(|slide| slide * slide.dot(&shift)).sum();
        let axis = turn.normalize();
        axes.push(axis);
        squares += Matrix3::identity() - axis * axis.transpose();
        moments += axis.cross(&(shift - explained)) * (radius / turn.norm());
    }
    let eigen = squares.symmetric_eigen();
    let inverse = eigen.eigenvalues.map(|v| if v > SHARP { 1.0 / v } else { 0.0 });
    let center = eigen.eigenvectors * inverse.component_mul(&(eigen.eigenvectors.transpose() * moments));
    let point = (center + V::from(origin)).into();

    let slides = slides.iter().map(|axis| FreeDirection::Translation { axis: upward(axis) });
    slides.chain(axes.iter().map(|axis| FreeDirection::Rotation { axis: upward(axis), point })).collect()
}

/// Of the two senses of an axis the one whose largest coordinate is positive.
fn upward(axis: &V) -> [f64; 3] {
    if axis[axis.iamax()] < 0.0 { (-axis).into() } else { (*axis).into() }
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector, Matrix6};
    use proptest::prelude::*;

    use super::*;
    use crate::Rigid;

    const RADIUS: f64 = 3.0;
    const ORIGIN: [f64; 3] = [100.0, -20.0, 7.0];

    /// The space of slides along and turns about axes through a point (relative to the origin), in some orthonormal
    /// basis that mixes them.
    fn space(slides: &[V], turns: &[V], point: V, mixed_by: u64) -> Matrix6xX<f64> {
        let slide = |s: &V| DVector::from_column_slice(&[0.0, 0.0, 0.0, s[0], s[1], s[2]]);
        let turn = |w: &V| {
            let v = point.cross(w);
            DVector::from_column_slice(&[RADIUS * w[0], RADIUS * w[1], RADIUS * w[2], v[0], v[1], v[2]])
        };
        let columns: Vec<_> = slides.iter().map(slide).chain(turns.iter().map(turn)).collect();
        let n = columns.len();
        let columns = DMatrix::from_columns(&columns);
        let mix = DMatrix::from_fn(n, n, |r, c| ((mixed_by + 1) as f64 * (3 * r + 7 * c + 1) as f64).sin());
        let q = (columns * (mix + DMatrix::identity(n, n) * 3.0)).qr().q();
        Matrix6xX::from_fn(n, |r, c| q[(r, c)])
    }

    fn slide_along(found: &FreeDirection) -> Option<V> {
        match found {
            FreeDirection::Translation { axis } => Some(V::from(*axis)),
            FreeDirection::Rotation { .. } => None,
        }
    }

    fn turn_about(found: &FreeDirection) -> Option<(V, V)> {
        match found {
            FreeDirection::Translation { .. } => None,
            FreeDirection::Rotation { axis, point } => Some((V::from(*axis), V::from(*point))),
        }
    }

    proptest! {
        #[test]
        fn shapes_are_named_whatever_the_basis(
            pose in prop::array::uniform6(-2.0_f64..2.0),
            mixed_by in 0_u64..1000,
        ) {
            let pose = Rigid::exp(&nalgebra::Vector6::from(pose));
            let [x, y, z] = [0, 1, 2].map(|k| pose.rotation.column(k).into_owned());
            let center = pose.translation;
            let in_file = center + V::from(ORIGIN);

            let plane = name(&space(&[x, y], &[z], center, mixed_by), RADIUS, ORIGIN);
            prop_assert_eq!(plane.len(), 3);
            prop_assert!(plane[..2].iter().all(|d| slide_along(d).unwrap().dot(&z).abs() < 1e-9));
            prop_assert!(turn_about(&plane[2]).unwrap().0.cross(&z).norm() < 1e-9);

            let cylinder = name(&space(&[z], &[z], center, mixed_by), RADIUS, ORIGIN);
            prop_assert_eq!(cylinder.len(), 2);
            prop_assert!(slide_along(&cylinder[0]).unwrap().cross(&z).norm() < 1e-9);
            let (axis, point) = turn_about(&cylinder[1]).unwrap();
            prop_assert!(axis.cross(&z).norm() < 1e-9 && (point - in_file).cross(&z).norm() < 1e-9);

            let corridor = name(&space(&[z], &[], center, mixed_by), RADIUS, ORIGIN);
            prop_assert_eq!(corridor.len(), 1);
            prop_assert!(slide_along(&corridor[0]).unwrap().cross(&z).norm() < 1e-9);

            let sphere = name(&space(&[], &[x, y, z], center, mixed_by), RADIUS, ORIGIN);
            prop_assert_eq!(sphere.len(), 3);
            for turn in &sphere {
                let off = (turn_about(turn).unwrap().1 - in_file).norm();
                prop_assert!(off < 1e-9, "{} {:?}", off, sphere);
            }
        }
    }

    #[test]
    fn nothing_free_and_everything_free() {
        assert!(name(&Matrix6xX::zeros(0), RADIUS, ORIGIN).is_empty());
        let all = Matrix6::<f64>::identity();
        let all = name(&Matrix6xX::from_fn(6, |r, c| all[(r, c)]), RADIUS, ORIGIN);
        assert_eq!(all.iter().filter_map(slide_along).count(), 3);
        assert!(all.iter().filter_map(turn_about).all(|(_, point)| point == V::from(ORIGIN)));
    }

    #[test]
    fn sentences_say_what_moves() {
        let slide = FreeDirection::Translation { axis: [1.0, -1e-9, 0.0] };
        assert_eq!(slide.to_string(), "the pose is free to slide along (1.0000, 0.0000, 0.0000)");
        let turn = FreeDirection::Rotation { axis: [0.0, 0.6, 0.8], point: [1.5, 0.0, -2.0] };
        assert_eq!(
            turn.to_string(),
            "the pose is free to turn about (0.0000, 0.6000, 0.8000) through (1.500000, 0.000000, -2.000000)"
        );
    }
}
