//! The network.

use std::borrow::Cow;
use std::path::PathBuf;
use std::sync::Arc;

use numpy::{PyArray2, PyReadonlyArray2};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};
use upcr::net::{EMBEDDED_WEIGHTS, Network};
use upcr_lab::files::write_atomically;

use crate::call::run_silent;
use crate::cloud::{array, rows};
use crate::errors::exception;
use crate::objects::dictionary;

/// A trained network with its weights file's bytes.
#[pyclass(module = "upcr._upcr", frozen)]
pub struct Model {
    /// Ready to be asked.
    pub network: Arc<Network>,
    /// What `upcr adapt` reads and this class pickles.
    pub weights: Cow<'static, [u8]>,
}

#[pymethods]
impl Model {
    /// The one in the package.
    #[staticmethod]
    fn default() -> PyResult<Self> {
        Ok(Self { network: Network::embedded().map_err(exception)?, weights: EMBEDDED_WEIGHTS.into() })
    }

    /// From a weights file.
    #[staticmethod]
    fn load(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        py.detach(|| {
            let network = Network::load(&path).map_err(exception)?;
            let weights =
                std::fs::read(&path).map_err(|source| exception(upcr::Error::Io { path, source }))?;
            Ok(Self { network: Arc::new(network), weights: weights.into() })
        })
    }

    /// From a weights file's bytes.
    #[staticmethod]
    pub fn from_bytes(py: Python<'_>, weights: Vec<u8>) -> PyResult<Self> {
        let network = py.detach(|| Network::from_safetensors(&weights)).map_err(exception)?;
        Ok(Self { network: Arc::new(network), weights: weights.into() })
    }

    /// The weights file's bytes.
    fn to_bytes<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, &self.weights)
    }

    /// Writes the weights file.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        py.detach(|| write_atomically(&path, &self.weights)).map_err(exception)
    }

    /// A number that tells weights apart, as a registration's settings have it.
    #[getter]
    fn fingerprint(&self) -> String {
        format!("{:016x}", self.network.fingerprint())
    }

    /// Whether the weights were trained.
    #[getter]
    fn is_trained(&self) -> bool {
        self.network.is_trained()
    }

    /// What the network is made of.
    #[getter]
    fn config<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        dictionary(py, self.network.config())
    }

    /// The pose that lays `source` on `target`, 4×4.
    fn predict<'py>(
        &self,
        py: Python<'py>,
        source: PyReadonlyArray2<'py, f32>,
        target: PyReadonlyArray2<'py, f32>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let (source, target) = (rows("source", &source)?, rows("target", &target)?);
        let network = self.network.clone();
        let pose = run_silent(py, move || network.predict(&source, &target))?;
        array(py, pose.map_err(exception)?.to_rows().to_vec())
    }
}
