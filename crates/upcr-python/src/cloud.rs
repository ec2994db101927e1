//! Clouds from NumPy arrays and back.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use numpy::ndarray::Array2;
use numpy::{Element, IntoPyArray, PyArray2, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::PyString;
use upcr::io::{self, ReadOptions};
use upcr::{CloudRole, PointCloud};

use crate::errors::{CloudError, exception, setting};

/// A cloud as Python hands it over: a file's name, or arrays that are copied once, so that they may change while the call
/// is under way.
pub enum Input {
    /// To be read when it is needed.
    File(PathBuf),
    /// Shared with other pairs of a batch.
    Points(Arc<PointCloud>),
}

/// Points, normals, colours and viewpoint: C-contiguous arrays with three columns.
type Arrays<'py> = (
    PyReadonlyArray2<'py, f64>,
    Option<PyReadonlyArray2<'py, f32>>,
    Option<PyReadonlyArray2<'py, u8>>,
    Option<[f64; 3]>,
);

impl FromPyObject<'_, '_> for Input {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, '_, PyAny>) -> PyResult<Self> {
        if object.is_instance_of::<PyString>() {
            return Ok(Self::File(object.extract()?));
        }
        let (points, normals, colors, viewpoint) = object.extract::<Arrays>()?;
        let points = rows("points", &points)?;
        let same_length = |name, found: Option<usize>| match found {
            Some(found) if found != points.len() => {
                let needed = points.len();
                Err(CloudError::new_err(format!("{name}: {found} rows, where there are {needed} points")))
            }
            _ => Ok(()),
        };
        let normals = normals.map(|array| rows("normals", &array)).transpose()?;
        let colors = colors.map(|array| rows("colors", &array)).transpose()?;
        same_length("normals", normals.as_ref().map(Vec::len))?;
        same_length("colors", colors.as_ref().map(Vec::len))?;
        Ok(Self::Points(Arc::new(PointCloud { points, normals, colors, viewpoint })))
    }
}

/// The rows of an array with three columns.
pub fn rows<T: Element + Copy>(name: &str, array: &PyReadonlyArray2<'_, T>) -> PyResult<Vec<[T; 3]>> {
    let refused = |reason: String| Err(CloudError::new_err(format!("{name}: {reason}")));
    match (array.shape(), array.as_slice()) {
        ([_, 3], Ok(values)) => Ok(values.as_chunks::<3>().0.to_vec()),
        ([_, 3], Err(error)) => refused(error.to_string()),
        (shape, _) => refused(format!("an array of shape (N, 3) is needed, not {shape:?}")),
    }
}

impl Input {
    /// The cloud, read where it is a file.
    pub fn get(&self) -> upcr::Result<Arc<PointCloud>> {
        match self {
            Self::File(path) => io::read_cloud(path).map(Arc::new),
            Self::Points(cloud) => Ok(cloud.clone()),
        }
    }

    /// The cloud as seen from `viewpoint`, where one is given.
    pub fn seen_from(&self, viewpoint: Option<[f64; 3]>) -> upcr::Result<Arc<PointCloud>> {
        let cloud = self.get()?;
        Ok(match viewpoint {
            Some(_) => Arc::new(PointCloud { viewpoint, ..Arc::unwrap_or_clone(cloud) }),
            None => cloud,
        })
    }

    /// The file's name.
    pub fn path(&self) -> Option<&Path> {
        match self {
            Self::File(path) => Some(path),
            Self::Points(_) => None,
        }
    }
}

/// The exception for an error about one of the clouds, which names its file where it came from one.
pub fn cloud_exception(error: upcr::Error, source: &Input, target: &Input) -> PyErr {
    let (upcr::Error::TooFewPoints { role, .. }
    | upcr::Error::NonFinite { role, .. }
    | upcr::Error::Degenerate { role, .. }) = &error
    else {
        return exception(error);
    };
    let cloud = if *role == CloudRole::Target { target } else { source };
    match cloud.path() {
        Some(path) => CloudError::new_err(format!("{}: {error}", path.display())),
        None => exception(error),
    }
}

/// A viewpoint that a keyword tells.
pub fn viewpoint(name: &str, given: Option<[f64; 3]>) -> PyResult<Option<[f64; 3]>> {
    match given {
        Some(place) if !place.iter().all(|v| v.is_finite()) => Err(setting(name, "the place is not finite")),
        given => Ok(given),
    }
}

/// What reading leaves open, where it is told.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Reading {
    mesh_samples: Option<usize>,
    mesh_seed: Option<u64>,
    intrinsics: Option<[f64; 4]>,
    depth_scale: Option<f64>,
    viewpoint: Option<[f64; 3]>,
}

impl Reading {
    /// The options, defaults where nothing was told.
    pub fn options(self) -> PyResult<ReadOptions> {
        let default = ReadOptions::default();
        let intrinsics = self.intrinsics.map(|[fx, fy, cx, cy]| io::Intrinsics { fx, fy, cx, cy });
        Ok(ReadOptions {
            mesh_samples: self.mesh_samples.unwrap_or(default.mesh_samples),
            seed: self.mesh_seed.unwrap_or(default.seed),
            intrinsics: intrinsics.or(default.intrinsics),
            depth_scale: self.depth_scale.unwrap_or(default.depth_scale),
            viewpoint: viewpoint("viewpoint", self.viewpoint)?.or(default.viewpoint),
        })
    }
}

/// Rows as an array that takes over their memory.
pub fn array<const D: usize, T: Element>(
    py: Python<'_>,
    rows: Vec<[T; D]>,
) -> PyResult<Bound<'_, PyArray2<T>>> {
    let rows = Array2::from_shape_vec((rows.len(), D), rows.into_flattened());
    Ok(rows.map_err(|error| PyRuntimeError::new_err(error.to_string()))?.into_pyarray(py))
}

/// A cloud's points, normals, colours and viewpoint.
pub type Columns<'py> = (
    Bound<'py, PyArray2<f64>>,
    Option<Bound<'py, PyArray2<f32>>>,
    Option<Bound<'py, PyArray2<u8>>>,
    Option<[f64; 3]>,
);

/// A cloud as arrays that take over its memory.
pub fn columns(py: Python<'_>, cloud: PointCloud) -> PyResult<Columns<'_>> {
    Ok((
        array(py, cloud.points)?,
        cloud.normals.map(|normals| array(py, normals)).transpose()?,
        cloud.colors.map(|colors| array(py, colors)).transpose()?,
        cloud.viewpoint,
    ))
}
