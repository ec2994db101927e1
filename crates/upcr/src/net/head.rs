//! The pose head: from the pose-related representation to a pose (section II-A).

use nalgebra::{Matrix3, Vector3};

use super::RotationKind;
use super::kernel::leaky;
use super::weights::Affine;
use crate::transform::{
    Rigid,
    euler::{self, EulerOrder},
    nearest_rotation, quaternion, six_d,
};

/// Fully connected layers, leaky rectifiers between them.
#[derive(Debug, Clone)]
pub(super) struct Head {
    layers: Vec<Linear>,
    slope: f32,
    rotation: RotationKind,
}

#[derive(Debug, Clone)]
struct Linear {
    /// A row an input.
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Head {
    pub fn new(layers: Vec<Affine>, slope: f32, rotation: RotationKind) -> Self {
        let layers = layers.into_iter().map(|map| Linear { weight: map.weight, bias: map.shift }).collect();
        Self { layers, slope, rotation }
    }

    /// The head's output, in `values`: those of a rotation, then three of a translation. `room` is scratch.
    pub fn apply(&self, representation: &[f32], values: &mut Vec<f32>, room: &mut Vec<f32>) {
        values.clear();
        values.extend_from_slice(representation);
        for (i, layer) in self.layers.iter().enumerate() {
            room.clear();
            room.extend_from_slice(&layer.bias);
            for (&x, row) in values.iter().zip(layer.weight.chunks_exact(room.len())) {
                for (sum, w) in room.iter_mut().zip(row) {
                    *sum += x * w;
                }
            }
            if i + 1 < self.layers.len() {
                for value in room.iter_mut() {
                    *value = leaky(*value, self.slope);
                }
            }
            std::mem::swap(values, room);
        }
    }

    /// The pose that the head's output stands for, its translation about the cloud's centroid.
    pub fn pose(&self, values: &[f32]) -> Rigid {
        let rotation = self.rotation.values();
        let translation = |a: usize| values.get(rotation + a).map_or(0.0, |v| f64::from(*v));
        Rigid {
            rotation: to_rotation(self.rotation, &values[..rotation.min(values.len())]),
            translation: Vector3::from([0, 1, 2].map(translation)),
        }
    }
}

/// The rotation that values of the head stand for; the identity where they determine none.
pub(super) fn to_rotation(kind: RotationKind, values: &[f32]) -> Matrix3<f64> {
    let v = |i: usize| values.get(i).map_or(0.0, |v| f64::from(*v));
    let rotation = match kind {
        RotationKind::Euler => Some(euler::to_rotation([v(0), v(1), v(2)], EulerOrder::Zyx)),
        RotationKind::Quaternion => quaternion::to_rotation([1.0 + v(0), v(1), v(2), v(3)]),
        RotationKind::SixD => six_d::to_rotation([1.0 + v(0), v(1), v(2), v(3), 1.0 + v(4), v(5)]),
        RotationKind::Matrix => {
            Some(nearest_rotation(&(Matrix3::identity() + Matrix3::from_fn(|r, c| v(3 * r + c)))))
        }
    };
    rotation.unwrap_or_else(Matrix3::identity)
}

#[cfg(test)]
mod tests {
    use safetensors::SafeTensors;

    use super::*;

    #[test]
    fn rotations_are_those_of_the_plain_network() {
        let bytes = include_bytes!("../../tests/golden/upcr_network.safetensors");
        let golden = SafeTensors::deserialize(bytes).unwrap();
        let values = |name: &str| -> Vec<f32> {
            let data = golden.tensor(name).unwrap().data();
            data.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
        };
        for (kind, name) in [
            (RotationKind::Euler, "euler"),
            (RotationKind::Quaternion, "quaternion"),
            (RotationKind::SixD, "six_d"),
            (RotationKind::Matrix, "matrix"),
        ] {
            let (inputs, rotations) =
                (values(&format!("rotation.{name}.values")), values(&format!("rotation.{name}.R")));
            for (inputs, rows) in inputs.chunks_exact(kind.values()).zip(rotations.chunks_exact(9)) {
                let expected = Matrix3::from_fn(|r, c| f64::from(rows[3 * r + c]));
                let found = to_rotation(kind, inputs);
                assert!((found - expected).amax() < 1e-6, "{name}: {found} {expected}");
            }
        }
    }

    #[test]
    fn values_that_determine_no_rotation_give_the_identity() {
        let nothing = [-1.0, 0.0, 0.0, 0.0, -1.0, 0.0];
        assert_eq!(to_rotation(RotationKind::Quaternion, &nothing[..4]), Matrix3::identity());
        assert_eq!(to_rotation(RotationKind::SixD, &nothing), Matrix3::identity());
    }
}
