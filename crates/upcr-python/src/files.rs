//! Files of clouds.

use std::path::PathBuf;

use pyo3::prelude::*;
use upcr::io::{self, Encoding, WriteOptions};

use crate::call::run_silent;
use crate::cloud::{Columns, Input, Reading, columns};
use crate::errors::{exception, setting};

/// Reads a cloud: its points, normals, colours and viewpoint.
#[pyfunction]
pub fn read(py: Python<'_>, path: PathBuf, options: Reading) -> PyResult<Columns<'_>> {
    let options = options.options()?;
    let cloud = run_silent(py, move || io::read_cloud_with(path, &options))?;
    columns(py, cloud.map_err(exception)?)
}

/// Writes a cloud; `encoding` is `binary`, `ascii`, `compressed` or the default.
#[pyfunction]
#[pyo3(signature = (path, cloud, encoding))]
pub fn write(py: Python<'_>, path: PathBuf, cloud: Input, encoding: Option<&str>) -> PyResult<()> {
    let encoding = match encoding {
        None => Encoding::default(),
        Some("binary") => Encoding::Binary,
        Some("ascii") => Encoding::Ascii,
        Some("compressed") => Encoding::Compressed,
        Some(other) => {
            let known = "binary, ascii, compressed";
            return Err(setting("encoding", format_args!("there is no {other}; there are {known}")));
        }
    };
    let write = move || io::write_cloud_with(path, &*cloud.get()?, &WriteOptions { encoding });
    run_silent(py, write)?.map_err(exception)
}
