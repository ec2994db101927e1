//! The native half of the Python package `upcr`: arrays in, plain objects out. What users see of it is in
//! `python/upcr`, which checks and shapes what goes in and gives what comes out its types.

// Arguments come from Python by value.
#![allow(clippy::needless_pass_by_value)]

mod adapt;
mod call;
mod cloud;
mod errors;
mod features;
mod files;
mod merge;
mod model;
mod objects;
mod register;
mod settings;

#[pyo3::pymodule]
mod _upcr {
    use pyo3::prelude::*;

    #[pymodule_export]
    use super::adapt::adapt;
    #[pymodule_export]
    use super::errors::{CloudError, Error, FormatError, SettingError, WeightsError};
    #[pymodule_export]
    use super::features::describe;
    #[pymodule_export]
    use super::files::{read, write};
    #[pymodule_export]
    use super::merge::{Scans, merge, scans_in};
    #[pymodule_export]
    use super::model::Model;
    #[pymodule_export]
    use super::register::{register, register_batch};
    #[pymodule_export]
    use super::settings::check;

    #[pymodule_export]
    const DEFAULT_K: usize = upcr::features::DEFAULT_K;
    #[pymodule_export]
    const TRUSTWORTHY: f64 = upcr::TRUSTWORTHY;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))?;
        module.add("CHOICES", super::settings::choices(module.py())?)
    }

    /// The command line; returns its exit status. The first of `args` is the program's name.
    #[pyfunction]
    fn main(py: Python<'_>, args: Vec<std::ffi::OsString>) -> u8 {
        py.detach(|| upcr_cli::run(args)) as u8
    }
}
