//! The settings of a registration from keywords.

use std::path::PathBuf;
use std::sync::Arc;

use clap::ValueEnum;
use numpy::{PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyString};
use upcr::features::MatchedFeature;
use upcr::io::read_transform;
use upcr::multiway::MergeSettings;
use upcr::net::Network;
use upcr::{Calibration, Locks, Method, Refinement, Rigid, RobustKernel, Settings};
use upcr_cli::Pairs;

use crate::errors::{exception, setting};
use crate::model::Model;

/// Settings from a dictionary of those that are told; `None` leaves the default.
pub fn settings(given: &Bound<'_, PyDict>) -> PyResult<Settings> {
    let mut settings = Settings::default();
    for (key, value) in given {
        let name: String = key.extract()?;
        if !value.is_none() {
            tell(&mut settings, &name, &value)?;
        }
    }
    Ok(settings)
}

/// As [`settings`], of a merge: with those that are its own.
pub fn merge_settings(given: &Bound<'_, PyDict>) -> PyResult<MergeSettings> {
    let mut settings = MergeSettings::default();
    for (key, value) in given {
        let name: String = key.extract()?;
        match name.as_str() {
            _ if value.is_none() => (),
            "neighbors" => settings.neighbors = typed(&name, &value)?,
            "sequential" => settings.sequential = typed(&name, &value)?,
            "max_memory_bytes" => settings.max_memory_bytes = Some(typed(&name, &value)?),
            _ => tell(&mut settings.registration, &name, &value)?,
        }
    }
    Ok(settings)
}

/// Refuses settings that no registration can have.
#[pyfunction]
pub fn check(given: &Bound<'_, PyDict>) -> PyResult<()> {
    settings(given)?.check().map_err(exception)
}

fn tell(settings: &mut Settings, name: &str, value: &Bound<'_, PyAny>) -> PyResult<()> {
    match name {
        "method" => settings.method = choice(name, value)?,
        "network" => settings.network = Some(network(name, value)?),
        "feature" => settings.feature = choice(name, value)?,
        "refine" => settings.refine = choice(name, value)?,
        "voxel_size" => settings.voxel_size = Some(typed(name, value)?),
        "init" => settings.init = Some(pose(name, value)?),
        "kernel" => settings.kernel = choice(name, value)?,
        "overlap" => settings.overlap = Some(typed(name, value)?),
        "locks" => settings.locks = locks(name, value)?,
        "calibration" => {
            let path: PathBuf = typed(name, value)?;
            settings.calibration = Some(Arc::new(Calibration::load(path).map_err(exception)?));
        }
        "seed" => settings.seed = typed(name, value)?,
        "threads" => settings.threads = Some(typed(name, value)?),
        "max_seconds" => settings.max_seconds = Some(typed(name, value)?),
        "max_memory_bytes" => settings.max_memory_bytes = Some(typed(name, value)?),
        other => return Err(PyTypeError::new_err(format!("there is no setting `{other}`"))),
    }
    Ok(())
}

/// A value of the setting's type; the exception says which setting has another.
fn typed<'py, T>(name: &str, value: &Bound<'py, PyAny>) -> PyResult<T>
where
    T: for<'a> FromPyObject<'a, 'py>,
{
    value.extract::<T>().map_err(|error| {
        let error: PyErr = error.into();
        let py = value.py();
        if error.is_instance_of::<PyTypeError>(py) {
            PyTypeError::new_err(format!("setting `{name}`: {}", error.value(py)))
        } else {
            setting(name, error.value(py))
        }
    })
}

/// One of the names that the library gives to its choices.
fn choice<T: ValueEnum>(name: &str, value: &Bound<'_, PyAny>) -> PyResult<T> {
    chosen(name, &typed::<String>(name, value)?)
}

/// The choice of that name.
pub fn chosen<T: ValueEnum>(name: &str, text: &str) -> PyResult<T> {
    let ignore_case = false;
    T::from_str(text, ignore_case)
        .map_err(|_| setting(name, format_args!("there is no {text}; there are {}", names::<T>().join(", "))))
}

/// The names of a setting's choices.
fn names<T: ValueEnum>() -> Vec<String> {
    let named = T::value_variants().iter().filter_map(ValueEnum::to_possible_value);
    named.map(|value| value.get_name().to_owned()).collect()
}

/// The names of all choices.
pub fn choices(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
    let choices = PyDict::new(py);
    choices.set_item("method", names::<Method>())?;
    choices.set_item("feature", names::<MatchedFeature>())?;
    choices.set_item("refine", names::<Refinement>())?;
    choices.set_item("kernel", names::<RobustKernel>())?;
    choices.set_item("pairs", names::<Pairs>())?;
    Ok(choices)
}

fn network(name: &str, value: &Bound<'_, PyAny>) -> PyResult<Arc<Network>> {
    if let Ok(model) = value.cast::<Model>() {
        return Ok(model.get().network.clone());
    }
    let path: PathBuf = typed(name, value)?;
    Ok(Arc::new(Network::load(path).map_err(exception)?))
}

/// A first guess: a 4×4 array, or the name of a file with one.
pub fn pose(name: &str, value: &Bound<'_, PyAny>) -> PyResult<Rigid> {
    if let Ok(path) = value.extract::<PathBuf>() {
        return read_transform(path).map_err(exception);
    }
    let matrix: PyReadonlyArray2<'_, f64> = typed(name, value)?;
    if matrix.shape() != [4, 4] {
        return Err(setting(
            name,
            format_args!("a 4x4 matrix is needed, not one of shape {:?}", matrix.shape()),
        ));
    }
    let matrix = matrix.as_array();
    let rows: [[f64; 4]; 4] = std::array::from_fn(|r| std::array::from_fn(|c| matrix[[r, c]]));
    Rigid::from_rows(&rows).map_err(|reason| setting(name, reason))
}

fn locks(name: &str, value: &Bound<'_, PyAny>) -> PyResult<Locks> {
    let axes: Vec<String> = if value.is_instance_of::<PyString>() {
        let text: String = value.extract()?;
        text.split(',').map(|axis| axis.trim().to_owned()).collect()
    } else {
        typed(name, value)?
    };
    let mut locks = Locks::default();
    for axis in axes {
        *match axis.as_str() {
            "roll" => &mut locks.roll,
            "pitch" => &mut locks.pitch,
            "yaw" => &mut locks.yaw,
            "x" => &mut locks.x,
            "y" => &mut locks.y,
            "z" => &mut locks.z,
            other => {
                let known = "roll, pitch, yaw, x, y, z";
                return Err(setting(name, format_args!("there is no axis {other}; there are {known}")));
            }
        } = true;
    }
    Ok(locks)
}
