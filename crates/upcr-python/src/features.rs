//! Descriptors of points.

use std::num::NonZeroUsize;

use numpy::{PyArray1, PyArray2, PyArrayMethods};
use pyo3::prelude::*;
use upcr::cloud::Support;
use upcr::features;

use crate::call::run_silent;
use crate::cloud::{Input, cloud_exception};
use crate::errors::setting;

/// The descriptor `kind` of every point, a row each, over the `k` nearest neighbours or those within `radius`.
#[pyfunction]
#[pyo3(signature = (cloud, kind, k, radius, threads))]
pub fn describe<'py>(
    py: Python<'py>,
    cloud: Input,
    kind: &str,
    k: usize,
    radius: Option<f64>,
    threads: Option<NonZeroUsize>,
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let Some(feature) = features::by_name(kind) else {
        let known: Vec<_> = features::ALL.iter().map(|feature| feature.name()).collect();
        return Err(setting("kind", format_args!("there is no {kind}; there are {}", known.join(", "))));
    };
    let support = radius.map_or(Support::Nearest(k), Support::Radius);
    let (rows, _) = run_silent(py, move || {
        let described = cloud.get().and_then(|cloud| features::describe(&cloud, feature, support, threads));
        described.map_err(|error| cloud_exception(error, &cloud, &cloud))
    })??;
    let shape = [rows.len(), rows.dim];
    PyArray1::from_vec(py, rows.values).reshape(shape)
}
