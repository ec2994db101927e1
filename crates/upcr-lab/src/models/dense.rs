//! Layers of the published networks, laid out as their files are: maps `[outputs, inputs]`, norms by channel.

use burn::module::{Module, Param};
use burn::tensor::Tensor;
use rand::Rng;

use super::layers::{Init, Statistics, towards};
use crate::ops;
use crate::ops::graph_layer::EPSILON;

/// A linear map of channels: PyTorch's `Linear`, and its convolutions over single points.
#[derive(Module, Debug)]
pub struct Dense {
    /// `[outputs, inputs]`.
    pub weight: Param<Tensor<2>>,
    /// `[outputs]`.
    pub bias: Option<Param<Tensor<1>>>,
}

impl Dense {
    pub(super) fn init(inputs: usize, outputs: usize, init: &mut Init<impl Rng>) -> Self {
        Self { bias: Some(init.uniform(inputs, 1.0, [outputs])), ..Self::without_bias(inputs, outputs, init) }
    }

    pub(super) fn without_bias(inputs: usize, outputs: usize, init: &mut Init<impl Rng>) -> Self {
        Self { weight: init.uniform(inputs, 1.0, [outputs, inputs]), bias: None }
    }

    /// `[rows, inputs]` → `[rows, outputs]`.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        self.rectified(x, 1.0)
    }

    /// The same, rectified with that slope for negative values (1: not at all).
    pub fn rectified(&self, x: Tensor<2>, slope: f32) -> Tensor<2> {
        ops::dense(x, self.weight.val(), self.shift(), slope)
    }

    /// The bias, or none.
    fn shift(&self) -> Tensor<1> {
        match &self.bias {
            Some(bias) => bias.val(),
            None => Tensor::zeros([self.weight.dims()[0]], &self.weight.device()),
        }
    }

    /// `[batch, rows, inputs]` → `[batch, rows, outputs]`.
    pub fn forward_batch(&self, x: Tensor<3>) -> Tensor<3> {
        self.rectified_batch(x, 1.0)
    }

    /// The same, rectified with that slope for negative values (1: not at all).
    pub fn rectified_batch(&self, x: Tensor<3>, slope: f32) -> Tensor<3> {
        let [batch, rows, inputs] = x.dims();
        let y = self.rectified(x.reshape([batch * rows, inputs]), slope);
        let outputs = y.dims()[1];
        y.reshape([batch, rows, outputs])
    }
}

/// Batch norm over rows.
#[derive(Module, Debug)]
pub struct BatchNorm {
    /// Scale, `[channels]`.
    pub weight: Param<Tensor<1>>,
    /// Shift, `[channels]`.
    pub bias: Param<Tensor<1>>,
    /// `[channels]`.
    pub running_mean: Param<Tensor<1>>,
    /// `[channels]`.
    pub running_var: Param<Tensor<1>>,
}

impl BatchNorm {
    pub(super) fn init(channels: usize, init: &mut Init<impl Rng>) -> Self {
        Self {
            weight: init.filled(1.0, channels),
            bias: init.filled(0.0, channels),
            running_mean: init.constant(0.0, [channels]),
            running_var: init.constant(1.0, [channels]),
        }
    }

    /// `[rows, channels]`, normalised by the running statistics or by the batch's, which are added to `found`.
    pub fn forward(&self, x: Tensor<2>, statistics: Statistics, found: &mut BatchStatistics) -> Tensor<2> {
        match statistics {
            Statistics::Batch => self.by_batch(x, 1.0, found),
            Statistics::Running => {
                let [scale, shift] = self.running();
                x * scale.unsqueeze() + shift.unsqueeze()
            }
        }
    }

    /// Rows through `map`, normalised, and rectified with that slope for negative values.
    pub fn after(
        &self,
        map: &Dense,
        x: Tensor<2>,
        slope: f32,
        statistics: Statistics,
        found: &mut BatchStatistics,
    ) -> Tensor<2> {
        match statistics {
            Statistics::Batch => self.by_batch(map.forward(x), slope, found),
            // Two affine maps are one.
            Statistics::Running => {
                let [scale, shift] = self.running();
                let outputs = scale.dims()[0];
                let weight = map.weight.val() * scale.clone().reshape([outputs, 1]);
                ops::dense(x, weight, map.shift() * scale + shift, slope)
            }
        }
    }

    fn by_batch(&self, x: Tensor<2>, slope: f32, found: &mut BatchStatistics) -> Tensor<2> {
        let rows = x.dims()[0] as f64;
        let normalized = ops::batch_norm(x, self.weight.val(), self.bias.val(), slope);
        let [mean, variance] = normalized.statistics;
        // The running variance is the unbiased one.
        found.push([mean, variance * (rows / (rows - 1.0).max(1.0))]);
        normalized.values
    }

    /// Scale and shift by the running statistics.
    fn running(&self) -> [Tensor<1>; 2] {
        let scale = (self.running_var.val() + EPSILON).sqrt().recip() * self.weight.val();
        let shift = self.bias.val() - self.running_mean.val() * scale.clone();
        [scale, shift]
    }

    /// The norm with its running statistics moved by `share` towards the next of a batch's.
    #[must_use]
    pub(super) fn observed<'a>(
        mut self,
        batch: &mut impl Iterator<Item = &'a [Tensor<1>; 2]>,
        share: f64,
    ) -> Self {
        if let Some([mean, variance]) = batch.next() {
            self.running_mean = self.running_mean.map(|running| towards(running, mean, share));
            self.running_var = self.running_var.map(|running| towards(running, variance, share));
        }
        self
    }
}

/// Mean and variance of a batch in each of a network's norms, in the order in which they are used.
pub type BatchStatistics = Vec<[Tensor<1>; 2]>;
