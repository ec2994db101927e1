//! Motions that the geometry leaves free, by name.

use nalgebra::{DMatrix, DVector, Matrix6xX, Vector3};
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
        let mut vector = |v: &[f64; 3], digits: usize| {
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

/// An axis this many radii away is one at infinity: turning about it is sliding.
const FAR_RADII: f64 = 5.0;

/// Splits a space of free motions into translations and rotations.
///
/// `free`: orthonormal columns, twists about `origin` with rotations in units of 1/`radius`.
pub(crate) fn name(free: &Matrix6xX<f64>, radius: f64, origin: [f64; 3]) -> Vec<FreeDirection> {
    if free.ncols() == 0 {
        return Vec::new();
    }
    // Combinations of the columns by how much they turn: the right singular vectors of the rotation parts.
    let turns = free.rows(0, 3).into_owned();
    let eigen = (turns.transpose() * &turns).symmetric_eigen();
    let mut order: Vec<usize> = (0..free.ncols()).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let twist = |k: usize| -> (Vector3<f64>, Vector3<f64>) {
        let twist = free * eigen.eigenvectors.column(k);
        (twist.fixed_rows::<3>(0).into(), twist.fixed_rows::<3>(3).into())
    };
    let is_slide = |k: &usize| eigen.eigenvalues[*k] < 1.0 / (1.0 + FAR_RADII * FAR_RADII);
    let slides: Vec<Vector3<f64>> =
        order.iter().copied().filter(is_slide).filter_map(|k| twist(k).1.try_normalize(0.0)).collect();
    let rotations: Vec<(Vector3<f64>, Vector3<f64>)> = order
        .iter()
        .copied()
        .filter(|k| !is_slide(k))
        .map(|k| {
            let (turn, shift) = twist(k);
            let along: Vector3<f64> = slides.iter().map(|s| s * s.dot(&shift)).sum();
            let rate = turn.norm() / radius;
            (turn.normalize(), (shift - along) / rate)
        })
        .collect();
    // v = c × ω for every axis ω through c.
    let mut equations = DMatrix::zeros(3 * rotations.len(), 3);
    let mut shifts = DVector::zeros(3 * rotations.len());
    for (k, (axis, shift)) in rotations.iter().enumerate() {
        equations.fixed_view_mut::<3, 3>(3 * k, 0).copy_from(&-axis.cross_matrix());
        shifts.rows_mut(3 * k, 3).copy_from(shift);
    }
    let center = if rotations.is_empty() {
        Vector3::zeros()
    } else {
        equations.svd(true, true).solve(&shifts, 1e-6).map_or_else(|_| Vector3::zeros(), |c| Vector3::new(c[0], c[1], c[2]))
    };
    let slides = slides.iter().map(|axis| FreeDirection::Translation { axis: upright(axis) });
    let point = (center + Vector3::from(origin)).into();
    let rotations = rotations.iter().map(|(axis, _)| FreeDirection::Rotation { axis: upright(axis), point });
    slides.chain(rotations).collect()
}

/// Of the two senses of an axis the one whose largest coordinate is positive.
fn upright(axis: &Vector3<f64>) -> [f64; 3] {
    if axis[axis.iamax()] < 0.0 { (-axis).into() } else { (*axis).into() }
}
