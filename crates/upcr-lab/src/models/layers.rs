//! What networks are built from.

use burn::module::{Module, Param, ParamId};
use burn::tensor::{Device, Tensor, TensorData};
use rand::Rng;
use upcr::{Error, Result};

use crate::ops::NormalizedMap;

/// Refuses widths that no layer has.
pub(super) fn check_channels(channels: usize) -> Result<()> {
    if (1..=1 << 14).contains(&channels) {
        return Ok(());
    }
    let reason = format!("a layer must have 1 to 16384 channels, not {channels}");
    Err(Error::InvalidSetting { name: "channels", reason })
}

/// Running statistics, moved by `share` towards a batch's.
pub(super) fn towards(running: Tensor<1>, batch: &Tensor<1>, share: f64) -> Tensor<1> {
    (running * (1.0 - share) + batch.clone() * share).detach()
}

/// Whose statistics normalise.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Statistics {
    /// The batch's: learning.
    Batch,
    /// The running ones: use.
    Running,
}

/// A source of parameters: random values from a seed, and ids in the order of asking, so that equal networks are equal
/// to the last bit.
pub(super) struct Init<'a, R> {
    pub rng: &'a mut R,
    pub device: &'a Device,
    next_id: u64,
}

impl<'a, R: Rng> Init<'a, R> {
    pub fn new(rng: &'a mut R, device: &'a Device) -> Self {
        Self { rng, device, next_id: 0 }
    }

    /// Whose gradient is learned from.
    fn parameter<const D: usize>(&mut self, values: Vec<f32>, shape: [usize; D]) -> Param<Tensor<D>> {
        self.next_id += 1;
        let tensor = Tensor::from_data(TensorData::new(values, shape), self.device);
        let tensor = if self.device.is_autodiff() { tensor.require_grad() } else { tensor };
        Param::initialized(ParamId::from(self.next_id), tensor)
    }

    /// Values that no gradient changes.
    pub fn constant<const D: usize>(&mut self, value: f32, shape: [usize; D]) -> Param<Tensor<D>> {
        self.next_id += 1;
        Param::initialized(ParamId::from(self.next_id), Tensor::full(shape, value, self.device))
    }

    /// Uniform in ±gain·√(1/inputs), as PyTorch draws the parameters of linear maps.
    pub fn uniform<const D: usize>(
        &mut self,
        inputs: usize,
        gain: f32,
        shape: [usize; D],
    ) -> Param<Tensor<D>> {
        let limit = gain / (inputs.max(1) as f32).sqrt();
        let count = shape.iter().product();
        let values = (0..count).map(|_| self.rng.random_range(-limit..=limit)).collect();
        self.parameter(values, shape)
    }

    fn weight(&mut self, inputs: usize, outputs: usize, gain: f32) -> Param<Tensor<2>> {
        self.uniform(inputs, gain, [inputs, outputs])
    }

    pub fn filled(&mut self, value: f32, length: usize) -> Param<Tensor<1>> {
        self.parameter(vec![value; length], [length])
    }
}

/// A linear map without bias, batch norm over edges, and a leaky rectifier.
#[derive(Module, Debug)]
pub struct NormalizedLayer {
    /// `[inputs, outputs]`.
    pub weight: Param<Tensor<2>>,
    /// Scale of the norm, `[outputs]`.
    pub gamma: Param<Tensor<1>>,
    /// Shift of the norm, `[outputs]`.
    pub beta: Param<Tensor<1>>,
    /// Running mean over edges, `[outputs]`.
    pub mean: Param<Tensor<1>>,
    /// Running variance over edges, `[outputs]`.
    pub var: Param<Tensor<1>>,
}

impl NormalizedLayer {
    pub(super) fn init(inputs: usize, outputs: usize, init: &mut Init<impl Rng>) -> Self {
        Self {
            weight: init.weight(inputs, outputs, 1.0),
            gamma: init.filled(1.0, outputs),
            beta: init.filled(0.0, outputs),
            mean: init.constant(0.0, [outputs]),
            var: init.constant(1.0, [outputs]),
        }
    }

    /// The parameters as an operation takes them.
    pub fn map(&self, negative_slope: f32) -> NormalizedMap {
        NormalizedMap {
            weight: self.weight.val(),
            gamma: self.gamma.val(),
            beta: self.beta.val(),
            negative_slope,
        }
    }

    /// Mean and variance to normalise with once learned.
    pub fn running(&self) -> [Tensor<1>; 2] {
        [self.mean.val(), self.var.val()]
    }

    /// Moves the running statistics by `share` towards a batch's.
    #[must_use]
    pub fn observed(mut self, batch: &[Tensor<1>; 2], share: f64) -> Self {
        let [mean, variance] = batch;
        self.mean = self.mean.map(|running| towards(running, mean, share));
        self.var = self.var.map(|running| towards(running, variance, share));
        self
    }
}

/// An affine map.
#[derive(Module, Debug)]
pub struct Linear {
    /// `[inputs, outputs]`.
    pub weight: Param<Tensor<2>>,
    /// `[outputs]`.
    pub bias: Param<Tensor<1>>,
}

impl Linear {
    pub(super) fn init(inputs: usize, outputs: usize, gain: f32, init: &mut Init<impl Rng>) -> Self {
        Self { weight: init.weight(inputs, outputs, gain), bias: init.filled(0.0, outputs) }
    }

    /// `[batch, inputs]` → `[batch, outputs]`.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        x.matmul(self.weight.val()) + self.bias.val().unsqueeze()
    }
}
