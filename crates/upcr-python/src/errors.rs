//! Errors as exceptions, with the library's words.

use std::io;
use std::path::Path;

use pyo3::create_exception;
use pyo3::exceptions::{PyOSError, PyValueError};
use pyo3::prelude::*;

create_exception!(
    upcr,
    Error,
    PyValueError,
    "Anything that the library refuses. A file that cannot be opened is an OSError, such as FileNotFoundError."
);
create_exception!(
    upcr,
    FormatError,
    Error,
    "A file is not what its format demands, its format is not known, or cannot hold what is to be written."
);
create_exception!(
    upcr,
    CloudError,
    Error,
    "A cloud has too few points, some that are not finite, or no surface."
);
create_exception!(upcr, SettingError, Error, "A setting is out of its range, or no such choice.");
create_exception!(upcr, WeightsError, Error, "Weights are not a network's, or learning has lost its way.");

/// The exception for an error of the library's.
pub fn exception(error: upcr::Error) -> PyErr {
    let text = error.to_string();
    match error {
        upcr::Error::Io { path, source } => os_error(&path, &source, text),
        upcr::Error::Malformed { .. } | upcr::Error::Unsupported { .. } => FormatError::new_err(text),
        upcr::Error::TooFewPoints { .. } | upcr::Error::NonFinite { .. } | upcr::Error::Degenerate { .. } => {
            CloudError::new_err(text)
        }
        upcr::Error::InvalidSetting { .. } | upcr::Error::TooLittleMemory { .. } => {
            SettingError::new_err(text)
        }
        upcr::Error::InvalidWeights { .. } | upcr::Error::Diverged { .. } => WeightsError::new_err(text),
        _ => Error::new_err(text),
    }
}

/// Where the system gave a number, Python chooses the subclass by it and keeps the file's name.
fn os_error(path: &Path, source: &io::Error, text: String) -> PyErr {
    match source.raw_os_error() {
        Some(number) => {
            let told = source.to_string();
            let told = told.split(" (os error").next().unwrap_or_default().to_owned();
            PyOSError::new_err((number, told, path.as_os_str().to_owned()))
        }
        None => io::Error::new(source.kind(), text).into(),
    }
}

/// An exception about a setting.
pub fn setting(name: &str, reason: impl std::fmt::Display) -> PyErr {
    SettingError::new_err(format!("setting `{name}`: {reason}"))
}
