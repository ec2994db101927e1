//! The poses that supervised networks learn from.

use burn::tensor::{Device, Tensor, TensorData};
use upcr::Rigid;

/// True rotations `[pairs, 3, 3]` and translations `[pairs, 3]`.
#[derive(Debug, Clone)]
pub struct Truth {
    /// From source to target.
    pub rotation: Tensor<3>,
    /// From source to target.
    pub translation: Tensor<2>,
}

impl Truth {
    /// No motion.
    pub fn identity(pairs: usize, device: &Device) -> Self {
        Self::of(&vec![Rigid::identity(); pairs], device)
    }

    /// How far poses are from it: the mean square of the entries of RᵀR' − I and of t − t', as DCP and PRNet learn.
    pub fn distance(&self, rotation: &Tensor<3>, translation: &Tensor<2>) -> Tensor<1> {
        let turn = rotation.clone().transpose().matmul(self.rotation.clone());
        let identity = Tensor::<2>::eye(3, &turn.device()).unsqueeze::<3>();
        (turn - identity).square().mean() + (translation.clone() - self.translation.clone()).square().mean()
    }

    /// From poses, on a device.
    pub fn of(poses: &[Rigid], device: &Device) -> Self {
        let pairs = poses.len();
        let rotations =
            poses.iter().flat_map(|pose| pose.rotation.transpose().iter().copied().collect::<Vec<_>>());
        let rotations: Vec<f32> = rotations.map(|v| v as f32).collect();
        let translations: Vec<f32> = poses
            .iter()
            .flat_map(|pose| pose.translation.iter().map(|&v| v as f32).collect::<Vec<_>>())
            .collect();
        Self {
            rotation: Tensor::from_data(TensorData::new(rotations, [pairs, 3, 3]), device),
            translation: Tensor::from_data(TensorData::new(translations, [pairs, 3]), device),
        }
    }
}
