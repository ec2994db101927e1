//! A network's weights as safetensors, in the layout that the product library reads.

use std::collections::BTreeMap;
use std::path::Path;

use burn::module::Param;
use burn::tensor::{Device, Tensor, TensorData};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use upcr::net::NetworkConfig;
use upcr::{Error, Result};

use super::layers::{Linear, NormalizedLayer};
use super::upcr::{Upcr, init};
use crate::random;

/// Metadata key under which the configuration stands.
const CONFIG_KEY: &str = "upcr.config";

/// Tensors of a file by name, as bytes with their shapes, and its free texts.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TensorFile {
    /// By name.
    pub tensors: BTreeMap<String, StoredTensor>,
    /// Free texts by key.
    pub metadata: BTreeMap<String, String>,
}

/// A tensor in a file.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredTensor {
    /// Type of the values.
    pub dtype: Dtype,
    /// Sizes, the slowest first.
    pub shape: Vec<usize>,
    /// Values, little-endian.
    pub bytes: Vec<u8>,
}

impl StoredTensor {
    /// From single-precision values.
    pub fn from_f32(values: &[f32], shape: &[usize]) -> Self {
        let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        Self { dtype: Dtype::F32, shape: shape.to_vec(), bytes }
    }

    /// The values, where they are single precision.
    pub fn to_f32(&self) -> Option<Vec<f32>> {
        let (values, rest) = self.bytes.as_chunks::<4>();
        (self.dtype == Dtype::F32 && rest.is_empty())
            .then(|| values.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect())
    }
}

impl TensorFile {
    /// Reads a file's bytes; `path` is what errors name.
    ///
    /// # Errors
    /// Where the bytes are no safetensors file.
    pub fn from_bytes(bytes: &[u8], path: &Path) -> Result<Self> {
        let malformed = |reason: String| malformed(path, reason);
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| malformed(e.to_string()))?;
        let file = SafeTensors::deserialize(bytes).map_err(|e| malformed(e.to_string()))?;
        let tensors = file.iter().map(|(name, view)| {
            let stored = StoredTensor {
                dtype: view.dtype(),
                shape: view.shape().to_vec(),
                bytes: view.data().to_vec(),
            };
            (name.to_owned(), stored)
        });
        let metadata = header.metadata().iter().flatten();
        let metadata = metadata.map(|(key, text)| (key.clone(), text.clone())).collect();
        Ok(Self { tensors: tensors.collect(), metadata })
    }

    /// The bytes of a file with these tensors.
    ///
    /// # Errors
    /// Where a tensor's bytes do not fit its shape.
    pub fn to_bytes(&self) -> Result<Vec<u8>> {
        let failed = |e: safetensors::SafeTensorError| Error::InvalidSetting {
            name: "weights",
            reason: e.to_string(),
        };
        let views = self
            .tensors
            .iter()
            .map(|(name, t)| Ok((name, TensorView::new(t.dtype, t.shape.clone(), &t.bytes).map_err(failed)?)))
            .collect::<Result<Vec<_>>>()?;
        let metadata = self.metadata.iter().map(|(key, text)| (key.clone(), text.clone())).collect();
        safetensors::serialize(views, Some(metadata)).map_err(failed)
    }
}

fn malformed(path: &Path, reason: String) -> Error {
    Error::Malformed { path: path.into(), format: "safetensors", reason }
}

/// The network's weights with its configuration.
pub fn store(network: &Upcr) -> TensorFile {
    let mut file = TensorFile::default();
    // A configuration of numbers and names has no value that JSON lacks.
    let config = serde_json::to_string(&network.config).unwrap_or_default();
    file.metadata.insert(CONFIG_KEY.into(), config);
    file.metadata.insert("upcr.version".into(), env!("CARGO_PKG_VERSION").into());
    visit(network, &mut |name, tensor| {
        let shape = tensor.shape().to_vec();
        let values: Vec<f32> = tensor.iter::<f32>().collect();
        file.tensors.insert(name, StoredTensor::from_f32(&values, &shape));
    });
    file
}

/// The network that a file holds.
///
/// # Errors
/// Where its configuration or a weight is missing or does not fit; `path` is what errors name.
pub fn restore(file: &TensorFile, path: &Path, device: &Device) -> Result<Upcr> {
    let config = file
        .metadata
        .get(CONFIG_KEY)
        .ok_or_else(|| malformed(path, format!("the metadata have no {CONFIG_KEY}")))?;
    let config: NetworkConfig =
        serde_json::from_str(config).map_err(|e| malformed(path, format!("{CONFIG_KEY}: {e}")))?;
    let mut network = init(&config, &mut random::stream(0, 0), device)?;
    fill(&mut network, file, path)?;
    Ok(network)
}

fn normalized_names(network: &Upcr) -> Vec<String> {
    let global = (0..network.global.len()).map(|l| format!("global.{l}"));
    let embed = network.embed.iter().map(|_| "invariant.embed".to_owned());
    let invariant = (0..network.invariant.len()).map(|l| format!("invariant.{l}"));
    global.chain(embed).chain(invariant).collect()
}

fn visit(network: &Upcr, visitor: &mut impl FnMut(String, TensorData)) {
    for (name, layer) in normalized_names(network).iter().zip(network.normalized_layers()) {
        visitor(format!("{name}.weight"), layer.weight.val().into_data());
        let vectors = [&layer.gamma, &layer.beta, &layer.mean, &layer.var];
        for (part, tensor) in ["gamma", "beta", "mean", "var"].iter().zip(vectors) {
            visitor(format!("{name}.{part}"), tensor.val().into_data());
        }
    }
    for (l, linear) in network.head.iter().enumerate() {
        visitor(format!("head.{l}.weight"), linear.weight.val().into_data());
        visitor(format!("head.{l}.bias"), linear.bias.val().into_data());
    }
}

fn fill(network: &mut Upcr, file: &TensorFile, path: &Path) -> Result<()> {
    let names = normalized_names(network);
    let layers = network.global.iter_mut().chain(&mut network.embed).chain(&mut network.invariant);
    for (name, layer) in names.iter().zip(layers) {
        let NormalizedLayer { weight, gamma, beta, mean, var } = layer;
        replace(weight, &format!("{name}.weight"), file, path)?;
        for (part, parameter) in [("gamma", gamma), ("beta", beta), ("mean", mean), ("var", var)] {
            replace(parameter, &format!("{name}.{part}"), file, path)?;
        }
    }
    for (l, Linear { weight, bias }) in network.head.iter_mut().enumerate() {
        replace(weight, &format!("head.{l}.weight"), file, path)?;
        replace(bias, &format!("head.{l}.bias"), file, path)?;
    }
    Ok(())
}

fn replace<const D: usize>(
    parameter: &mut Param<Tensor<D>>,
    name: &str,
    file: &TensorFile,
    path: &Path,
) -> Result<()> {
    let stored = file.tensors.get(name).ok_or_else(|| malformed(path, format!("{name} is missing")))?;
    let old = parameter.val();
    let shape = old.dims();
    let values = stored
        .to_f32()
        .filter(|values| stored.shape == shape && values.iter().all(|v| v.is_finite()))
        .ok_or_else(|| {
            malformed(path, format!("{name} must be finite single-precision values of shape {shape:?}"))
        })?;
    let tensor = Tensor::from_data(TensorData::new(values, shape), &old.device());
    let tensor = if old.is_require_grad() { tensor.require_grad() } else { tensor };
    *parameter = Param::initialized(parameter.id, tensor);
    Ok(())
}
