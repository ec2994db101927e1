//! A module's tensors under the names of its fields: for the published networks, those that their files have.

use std::collections::BTreeMap;
use std::path::Path;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Tensor, TensorData};
use upcr::{Error, Result};

use super::tensor_file::{StoredTensor, TensorFile, malformed};

/// All tensors of a module.
pub fn tensors(module: &impl Module) -> BTreeMap<String, StoredTensor> {
    let mut collector = Collector::default();
    module.visit(&mut collector);
    collector.tensors
}

/// The module with the file's tensors, found by what `stored_name` makes of the fields', in place of its own. Trailing sizes of one, which convolutions over single points
/// have, do not count; the file may hold more than the module has.
///
/// # Errors
/// Where a tensor is missing, of another shape or type, or not finite; `path` is what errors name.
pub fn filled<M: Module>(
    module: M,
    file: &TensorFile,
    path: &Path,
    stored_name: fn(&str) -> String,
) -> Result<M> {
    let mut filler = Filler { fields: Fields::default(), stored_name, file, path, failed: None };
    let module = module.map(&mut filler);
    filler.failed.map_or(Ok(module), Err)
}

/// The fields that lead to a tensor. Variants of an enum have no name.
#[derive(Default)]
struct Fields(Vec<Option<String>>);

impl Fields {
    fn enter(&mut self, name: &str, container: &str) {
        self.0.push((!container.starts_with("Enum:")).then(|| name.to_owned()));
    }

    fn exit(&mut self) {
        self.0.pop();
    }

    fn name(&self) -> String {
        self.0.iter().flatten().map(String::as_str).collect::<Vec<_>>().join(".")
    }
}

#[derive(Default)]
struct Collector {
    fields: Fields,
    tensors: BTreeMap<String, StoredTensor>,
}

impl ModuleVisitor for Collector {
    fn enter_module(&mut self, name: &str, container: &str) {
        self.fields.enter(name, container);
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.fields.exit();
    }

    fn visit_float<const D: usize>(&mut self, parameter: &Param<Tensor<D>>) {
        let data = parameter.val().into_data();
        let values: Vec<f32> = data.iter::<f32>().collect();
        self.tensors.insert(self.fields.name(), StoredTensor::from_f32(&values, &data.shape().to_vec()));
    }
}

struct Filler<'a> {
    fields: Fields,
    stored_name: fn(&str) -> String,
    file: &'a TensorFile,
    path: &'a Path,
    failed: Option<Error>,
}

impl ModuleMapper for Filler<'_> {
    fn enter_module(&mut self, name: &str, container: &str) {
        self.fields.enter(name, container);
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.fields.exit();
    }

    fn map_float<const D: usize>(&mut self, parameter: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let name = (self.stored_name)(&self.fields.name());
        match stored(self.file, &name, parameter.val().dims(), self.path) {
            Ok(data) => {
                let old = parameter.val();
                let tensor = Tensor::from_data(data, &old.device());
                let tensor = if old.is_require_grad() { tensor.require_grad() } else { tensor };
                Param::initialized(parameter.id, tensor)
            }
            Err(error) => {
                self.failed.get_or_insert(error);
                parameter
            }
        }
    }
}

fn stored<const D: usize>(
    file: &TensorFile,
    name: &str,
    shape: [usize; D],
    path: &Path,
) -> Result<TensorData> {
    let stored = file.tensors.get(name).ok_or_else(|| malformed(path, format!("{name} is missing")))?;
    let sizes = |shape: &[usize]| {
        let end = shape.iter().rposition(|&size| size != 1).map_or(0, |last| last + 1);
        shape[..end].to_vec()
    };
    let values = stored
        .to_f32()
        .filter(|values| sizes(&stored.shape) == sizes(&shape) && values.iter().all(|v| v.is_finite()))
        .ok_or_else(|| {
            malformed(path, format!("{name} must be finite single-precision values of shape {shape:?}"))
        })?;
    Ok(TensorData::new(values, shape))
}
