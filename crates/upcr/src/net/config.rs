//! What a network is made of: enough, with its weights, to build it again.

use serde::{Deserialize, Serialize};

use super::Invariant;
use crate::error::{Error, Result};

/// The shape of a UPCR network. The default is the paper's: K = 24, five graph layers, m = 512, Euler angles.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NetworkConfig {
    /// Neighbours of a point, itself included (K).
    pub k: usize,
    /// Channels after each graph layer; the last is the representation's dimension m.
    pub widths: Vec<usize>,
    /// Where a layer's neighbours come from.
    pub graph: GraphKind,
    /// Slope of the leaky rectifier for negative values, 0 to 1.
    pub negative_slope: f32,
    /// The pose-invariant feature that the second branch starts from.
    pub invariant: Invariant,
    /// How the pose head writes a rotation.
    pub rotation: RotationKind,
    /// Channels of the pose head's hidden layers.
    pub head: Vec<usize>,
}

/// Where a layer's neighbours come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum), value(rename_all = "snake_case"))]
pub enum GraphKind {
    /// From the points' positions, once for all layers.
    #[default]
    Static,
    /// From each layer's own input features.
    Dynamic,
}

/// How the pose head writes a rotation (the paper's rotation ablation).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum), value(rename_all = "snake_case"))]
pub enum RotationKind {
    /// Three angles in rad: R = Rx·Ry·Rz.
    #[default]
    Euler,
    /// A quaternion (w, x, y, z), normalised; the head's output is added to the identity's.
    Quaternion,
    /// The first two columns, orthonormalised by Gram–Schmidt; added to the identity's.
    SixD,
    /// All nine entries, row by row, added to the identity's; the nearest rotation is taken.
    Matrix,
}

impl RotationKind {
    /// Values that the head gives for a rotation.
    pub fn values(self) -> usize {
        match self {
            Self::Euler => 3,
            Self::Quaternion => 4,
            Self::SixD => 6,
            Self::Matrix => 9,
        }
    }
}

impl Default for NetworkConfig {
    fn default() -> Self {
        Self {
            k: crate::features::DEFAULT_K,
            widths: vec![64, 64, 128, 256, 512],
            graph: GraphKind::Static,
            negative_slope: 0.2,
            invariant: Invariant::Distance,
            rotation: RotationKind::Euler,
            head: vec![256, 128],
        }
    }
}

impl NetworkConfig {
    /// Dimension m of the representation.
    pub fn representation(&self) -> usize {
        self.widths.last().copied().unwrap_or(0)
    }

    /// Refuses what makes no network.
    ///
    /// # Errors
    /// Where a number is out of its range.
    pub fn check(&self) -> Result<()> {
        let refused = |name, reason: String| Err(Error::InvalidSetting { name, reason });
        if !(1..=255).contains(&self.k) {
            return refused("k", format!("must be 1 to 255 neighbours, not {}", self.k));
        }
        if self.widths.is_empty() {
            return refused("widths", "at least one graph layer is needed".into());
        }
        let widest = self.widths.iter().chain(&self.head).copied();
        if let Some(width) = widest.clone().find(|width| !(1..=1 << 14).contains(width)) {
            return refused("widths", format!("a layer must have 1 to 16384 channels, not {width}"));
        }
        if !(0.0..=1.0).contains(&self.negative_slope) {
            let reason = format!("must lie in 0 to 1, not {}", self.negative_slope);
            return refused("negative_slope", reason);
        }
        Ok(())
    }
}
