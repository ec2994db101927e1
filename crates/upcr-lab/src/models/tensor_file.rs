//! Tensors by name, and safetensors files of them.

use std::cmp::Reverse;
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
        // A pickle, or a ZIP archive.
        let pytorch = bytes.starts_with(&[0x80, 0x02]) || bytes.starts_with(b"PK");
        let hint = if pytorch { "; it looks like PyTorch's, which `upcr import` reads" } else { "" };
        let malformed = |reason: String| malformed(path, reason + hint);
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

    /// The bytes of a file with these tensors: equal ones for equal contents.
    ///
    /// # Errors
    /// Where a tensor's bytes do not fit its shape.
    pub fn to_bytes(&self) -> Result<Vec<u8>> {
        let mut header = BTreeMap::new();
        if !self.metadata.is_empty() {
            header.insert("__metadata__", serde_json::json!(self.metadata));
        }
        // Wide types first keep every tensor aligned.
        let mut tensors: Vec<_> = self.tensors.iter().collect();
        tensors.sort_by_key(|(name, tensor)| (Reverse(tensor.dtype.bitsize()), *name));
        let mut data = Vec::new();
        for (name, tensor) in tensors {
            let start = data.len();
            data.extend_from_slice(&tensor.bytes);
            let view = TensorView::new(tensor.dtype, tensor.shape.clone(), &tensor.bytes);
            view.map_err(|e| Error::InvalidSetting { name: "weights", reason: format!("{name}: {e}") })?;
            let entry = serde_json::json!({
                "dtype": tensor.dtype,
                "shape": tensor.shape,
                "data_offsets": [start, data.len()],
            });
            header.insert(name, entry);
        }
        // Names and numbers have a JSON form.
        let mut header = serde_json::to_vec(&header).unwrap_or_default();
        header.resize(header.len().next_multiple_of(8), b' ');
        let length = (header.len() as u64).to_le_bytes();
        Ok([&length[..], &header, &data].concat())
    }
}

pub(super) fn malformed(path: &Path, reason: String) -> Error {
    Error::Malformed { path: path.into(), format: "safetensors", reason }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_come_back_and_equal_ones_are_equal_to_the_byte() {
        let mut file = TensorFile::default();
        for name in ["b", "a", "c.weight"] {
            file.tensors
                .insert(name.into(), StoredTensor::from_f32(&[1.0, -2.5, 3.0, 0.0, 7.0, 9.0], &[2, 3]));
        }
        let odd = StoredTensor { dtype: Dtype::U8, shape: vec![5], bytes: vec![1, 2, 3, 4, 5] };
        file.tensors.insert("a.odd".into(), odd);
        for key in ["one", "two", "three", "four"] {
            file.metadata.insert(key.into(), format!("{key} \"quoted\""));
        }
        let bytes = file.to_bytes().unwrap();
        assert_eq!(TensorFile::from_bytes(&bytes, Path::new("file")).unwrap(), file);
        assert_eq!(file.clone().to_bytes().unwrap(), bytes);
        if let Some(tensor) = file.tensors.get_mut("b") {
            tensor.shape = vec![7];
        }
        assert!(file.to_bytes().is_err());
    }

    #[test]
    fn files_of_pytorch_are_told() {
        let error = TensorFile::from_bytes(b"PK\x03\x04 and so on", Path::new("file")).unwrap_err();
        assert!(error.to_string().contains("upcr import"), "{error}");
    }
}
