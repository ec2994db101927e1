//! PyTorch's files, of every age: names, types and values of the tensors in them.

use std::path::Path;

use pytorch_reader::{DType, PytorchError, PytorchReader};
use safetensors::tensor::Dtype;
use upcr::{Error, Result};

use super::tensor_file::{StoredTensor, TensorFile};

/// The tensors of a file. Counters and the like, which are not single precision, keep their type.
///
/// # Errors
/// Where the file cannot be read, or holds types other than numbers of 32 or 64 bits.
pub fn read(path: &Path) -> Result<TensorFile> {
    let malformed = |reason: String| Error::Malformed { path: path.into(), format: "PyTorch", reason };
    let io = |source| Error::Io { path: path.into(), source };
    let reader = PytorchReader::new(path).map_err(|error| match error {
        PytorchError::Io(source) => io(source),
        other => malformed(other.to_string()),
    })?;
    let mut file = TensorFile::default();
    for (name, tensor) in reader.into_tensors() {
        let dtype = match tensor.dtype() {
            DType::F32 => Dtype::F32,
            DType::F64 => Dtype::F64,
            DType::I32 => Dtype::I32,
            DType::I64 => Dtype::I64,
            other => return Err(malformed(format!("{name} is of the type {other:?}"))),
        };
        let bytes = tensor.read().map_err(io)?;
        file.tensors.insert(name, StoredTensor { dtype, shape: tensor.shape().to_vec(), bytes });
    }
    Ok(file)
}
