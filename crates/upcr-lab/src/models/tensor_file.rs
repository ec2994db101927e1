//! Tensors by name, and safetensors files of them.

use std::collections::BTreeMap;
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use upcr::{Error, Result};

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

pub(super) fn malformed(path: &Path, reason: String) -> Error {
    Error::Malformed { path: path.into(), format: "safetensors", reason }
}
