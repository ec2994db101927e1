//! Weights files: safetensors with the network's configuration in their metadata.

use safetensors::{Dtype, SafeTensors, tensor::TensorView};

use super::NetworkConfig;
use crate::error::{Error, Result};

/// Added to a variance under the root, as in training.
const EPSILON: f64 = 1e-5;
/// Metadata of a weights file.
const CONFIG_KEY: &str = "upcr.config";
/// Under it other networks that are trained here have their configuration.
const OTHER_KEY: &str = "upcr.network";
const TRAINED_KEY: &str = "upcr.trained";

/// An opened weights file. Tensors beside those that the network asks for are no error.
pub(super) struct Weights<'a> {
    tensors: SafeTensors<'a>,
    pub config: NetworkConfig,
    /// Whether the file does not say that its weights are random.
    pub trained: bool,
}

/// A linear map and a constant. The matrix is row-major, `inputs` × `outputs`.
pub(super) struct Affine {
    pub inputs: usize,
    pub outputs: usize,
    pub weight: Vec<f32>,
    pub shift: Vec<f32>,
}

impl Affine {
    /// Row `input` of the matrix.
    pub fn row(&self, input: usize) -> &[f32] {
        &self.weight[input * self.outputs..(input + 1) * self.outputs]
    }
}

impl<'a> Weights<'a> {
    pub fn open(bytes: &'a [u8]) -> Result<Self> {
        let unreadable = |e: safetensors::SafeTensorError| invalid(format!("no safetensors file: {e}"));
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(unreadable)?;
        let tensors = SafeTensors::deserialize(bytes).map_err(unreadable)?;
        let entry = |key| header.metadata().as_ref().and_then(|entries| entries.get(key));
        let config = entry(CONFIG_KEY).ok_or_else(|| {
            invalid(match entry(OTHER_KEY) {
                Some(other) => format!("weights of another network than UPCR's, {other}"),
                None => format!("no `{CONFIG_KEY}` in its metadata"),
            })
        })?;
        let config: NetworkConfig =
            serde_json::from_str(config).map_err(|e| invalid(format!("`{CONFIG_KEY}`: {e}")))?;
        config.check()?;
        let trained = entry(TRAINED_KEY).is_none_or(|value| value != "false");
        Ok(Self { tensors, config, trained })
    }

    /// The map over edges that is stored under `name`, with the batch norm after it folded in.
    pub fn edge_map(&self, name: &str, inputs: usize, outputs: usize) -> Result<Affine> {
        let mut weight = self.values(&format!("{name}.weight"), &[inputs, outputs])?;
        let channel = |part: &str| self.values(&format!("{name}.{part}"), &[outputs]);
        let (gamma, beta, mean, var) =
            (channel("gamma")?, channel("beta")?, channel("mean")?, channel("var")?);
        if let Some(negative) = var.iter().find(|v| **v < 0.0) {
            return Err(invalid(format!("`{name}.var` holds a negative variance, {negative}")));
        }
        // A negative scale turns the maximum over neighbours into a minimum, and the values with it: the folded map
        // has the maximum again.
        let scale: Vec<f64> =
            gamma.iter().zip(&var).map(|(g, v)| f64::from(*g) / (f64::from(*v) + EPSILON).sqrt()).collect();
        for row in weight.chunks_exact_mut(outputs) {
            for (w, s) in row.iter_mut().zip(&scale) {
                *w = (f64::from(*w) * s) as f32;
            }
        }
        let shift = beta.iter().zip(&mean).zip(&scale);
        let shift = shift.map(|((b, m), s)| (f64::from(*b) - f64::from(*m) * s) as f32).collect();
        Ok(Affine { inputs, outputs, weight, shift })
    }

    /// The fully connected layer that is stored under `name`.
    pub fn linear(&self, name: &str, inputs: usize, outputs: usize) -> Result<Affine> {
        let weight = self.values(&format!("{name}.weight"), &[inputs, outputs])?;
        let shift = self.values(&format!("{name}.bias"), &[outputs])?;
        Ok(Affine { inputs, outputs, weight, shift })
    }

    /// A tensor of that shape, all of it finite.
    fn values(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>> {
        let tensor = self.tensors.tensor(name).map_err(|_| invalid(format!("`{name}` is missing")))?;
        if tensor.shape() != shape {
            let found = tensor.shape();
            return Err(invalid(format!("`{name}` has the shape {found:?}, where {shape:?} is needed")));
        }
        let values = single_precision(name, &tensor)?;
        match values.iter().find(|v| !v.is_finite()) {
            Some(value) => Err(invalid(format!("`{name}` holds {value}"))),
            None => Ok(values),
        }
    }
}

fn single_precision(name: &str, tensor: &TensorView) -> Result<Vec<f32>> {
    let data = tensor.data();
    let halves = || data.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b));
    match tensor.dtype() {
        Dtype::F32 => Ok(data.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()),
        Dtype::F16 => Ok(halves().map(from_half).collect()),
        Dtype::BF16 => Ok(halves().map(|bits| f32::from_bits(u32::from(bits) << 16)).collect()),
        other => Err(invalid(format!("`{name}` holds {other:?}, where F32, F16 or BF16 is needed"))),
    }
}

/// The value of an IEEE 754 half.
fn from_half(bits: u16) -> f32 {
    let sign = if bits >> 15 == 1 { -1.0 } else { 1.0 };
    let (exponent, fraction) = (u32::from(bits >> 10 & 0x1f), u32::from(bits & 0x3ff));
    let magnitude = match exponent {
        // 2⁻²⁴ is the smallest of them.
        0 => fraction as f32 / (1u32 << 24) as f32,
        0x1f if fraction == 0 => f32::INFINITY,
        0x1f => f32::NAN,
        _ => f32::from_bits((exponent + 127 - 15) << 23 | fraction << 13),
    };
    sign * magnitude
}

fn invalid(reason: String) -> Error {
    Error::InvalidWeights { reason }
}

#[cfg(test)]
mod tests {
    use super::from_half;

    #[test]
    fn halves_are_what_the_standard_says() {
        let cases = [
            (0x0000, 0.0),
            (0x0001, 5.960_464_5e-8),
            (0x03ff, 6.097_555e-5),
            (0x0400, 6.103_515_6e-5),
            (0x3c00, 1.0),
            (0x3555, 0.333_251_95),
            (0xc000, -2.0),
            (0x7bff, 65504.0),
            (0xfc00, f32::NEG_INFINITY),
        ];
        for (bits, value) in cases {
            assert_eq!(from_half(bits), value, "{bits:#x}");
        }
        assert!(from_half(0x7c01).is_nan());
    }
}
