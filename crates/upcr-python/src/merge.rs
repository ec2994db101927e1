//! Many scans into models: what `upcr merge` of the command line does.

use std::ffi::OsString;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use pyo3::IntoPyObjectExt;
use pyo3::exceptions::{PyIndexError, PyRuntimeError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use serde::Serialize;
use upcr::multiway::{self, MergeProgress, MergeStep, MergeWatch, Merged, Place as ScanPlace};
use upcr::{PointCloud, Rigid};
use upcr_cli::short_names;

use crate::call::{Caller, Place, pool, run, run_silent};
use crate::cloud::{Columns, Input, columns, viewpoint};
use crate::errors::{exception, setting};
use crate::objects::dictionary;
use crate::settings::merge_settings;

/// Scans: files, which are read when they are needed and as often, and clouds, which are held.
#[pyclass(module = "upcr._upcr", frozen)]
pub struct Scans {
    inputs: Arc<[Input]>,
    /// Where the sensor stood in each scan's own frame, where the scan does not say.
    viewpoint: Option<[f64; 3]>,
}

#[pymethods]
impl Scans {
    #[new]
    #[pyo3(signature = (scans, viewpoint))]
    fn new(scans: Vec<Input>, viewpoint: Option<[f64; 3]>) -> PyResult<Self> {
        Ok(Self { inputs: scans.into(), viewpoint: self::viewpoint("viewpoint", viewpoint)? })
    }

    /// What they are called: files as they are told from each other, clouds by their number.
    #[getter]
    fn names(&self) -> Vec<String> {
        let files: Vec<&Path> = self.inputs.iter().filter_map(Input::path).collect();
        let mut short = short_names(&files).into_iter();
        let name = |(number, input): (usize, &Input)| {
            let file = input.path().and_then(|_| short.next());
            file.unwrap_or_else(|| format!("scan {number}"))
        };
        self.inputs.iter().enumerate().map(name).collect()
    }

    /// The cloud of some of them, each moved by its pose, with one point in each cell of edge `thin`. `progress` is called with
    /// the number of scans that are done.
    #[pyo3(signature = (poses, thin, progress))]
    fn fuse<'py>(
        &self,
        py: Python<'py>,
        poses: Vec<(usize, [[f64; 4]; 4])>,
        thin: f64,
        progress: Option<Bound<'py, PyAny>>,
    ) -> PyResult<Columns<'py>> {
        if let Some((scan, _)) = poses.iter().find(|(scan, _)| *scan >= self.inputs.len()) {
            return Err(PyIndexError::new_err(*scan));
        }
        let poses: Vec<_> = poses.into_iter().map(|(scan, rows)| (scan, exactly(&rows))).collect();
        let (inputs, viewpoint) = (self.inputs.clone(), self.viewpoint);
        let work = move |caller: &Caller<usize>| {
            let reader = Reader { inputs: &inputs, viewpoint, caller };
            multiway::fuse(&reader, &poses, thin, &|done| caller.tell(done))
        };
        let hear = |done| progress.as_ref().map_or(Ok(()), |progress| progress.call1((done,)).map(drop));
        match run(py, Place::Pool(pool(py)?), work, hear)? {
            Ok(cloud) => columns(py, cloud),
            Err(upcr::Error::InvalidSetting { reason, .. }) => Err(setting("thin", reason)),
            Err(error) => Err(exception(error)),
        }
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<(Bound<'py, PyType>, Parts<'py>)> {
        let (py, scans) = (slf.py(), slf.get());
        let inputs = scans.inputs.iter().map(|input| match input {
            Input::File(path) => path.as_os_str().into_bound_py_any(py),
            Input::Points(cloud) => columns(py, PointCloud::clone(cloud))?.into_bound_py_any(py),
        });
        Ok((slf.get_type(), (inputs.collect::<PyResult<_>>()?, scans.viewpoint)))
    }
}

/// What scans are made of.
type Parts<'py> = (Vec<Bound<'py, PyAny>>, Option<[f64; 3]>);

/// Reads scans for as long as somebody waits for them.
struct Reader<'a, E> {
    inputs: &'a [Input],
    viewpoint: Option<[f64; 3]>,
    caller: &'a Caller<E>,
}

impl<E> multiway::Scans for Reader<'_, E> {
    fn len(&self) -> usize {
        self.inputs.len()
    }

    fn read(&self, scan: usize) -> upcr::Result<PointCloud> {
        waited_for(self.caller)?;
        let cloud = Arc::unwrap_or_clone(self.inputs[scan].get()?);
        Ok(PointCloud { viewpoint: cloud.viewpoint.or(self.viewpoint), ..cloud })
    }
}

/// An error, which nobody hears, where nobody waits.
fn waited_for<E>(caller: &Caller<E>) -> upcr::Result<()> {
    if caller.is_gone() {
        return Err(upcr::Error::Io { path: PathBuf::new(), source: ErrorKind::Interrupted.into() });
    }
    Ok(())
}

/// The motion that these rows are, to the last bit.
fn exactly(rows: &[[f64; 4]; 4]) -> Rigid {
    let mut motion = Rigid::identity();
    for r in 0..3 {
        for c in 0..3 {
            motion.rotation[(r, c)] = rows[r][c];
        }
        motion.translation[r] = rows[r][3];
    }
    motion
}

/// What came of a merge, but for its pairs.
#[derive(Serialize)]
struct Told<'a> {
    places: &'a [ScanPlace],
    /// Of each scan, why it lies in no model.
    reasons: Vec<Option<&'a str>>,
    voxel_size: f64,
    inflation: f64,
}

/// Finds the poses of all scans; `progress` is called with a step, what is done of it and all of it. Returns what came of it,
/// and the JSON of the pairs.
#[pyfunction]
#[pyo3(signature = (scans, given, progress))]
pub fn merge<'py>(
    py: Python<'py>,
    scans: &Bound<'py, Scans>,
    given: &Bound<'py, PyDict>,
    progress: Option<Bound<'py, PyAny>>,
) -> PyResult<(Bound<'py, PyDict>, String)> {
    let settings = merge_settings(given)?;
    let (inputs, viewpoint) = (scans.get().inputs.clone(), scans.get().viewpoint);
    // A name of nothing is a mistake, not a scan of no use.
    for path in inputs.iter().filter_map(Input::path) {
        let there = fs::metadata(path).map(drop);
        there.map_err(|source| exception(upcr::Error::Io { path: path.to_owned(), source }))?;
    }
    let work = move |caller: &Caller<MergeProgress>| {
        let reader = Reader { inputs: &inputs, viewpoint, caller };
        // What is read and what is told asks whether anybody waits: nothing else ends a merge.
        let (pair, progress) = (|_: &_| waited_for(caller), |at| caller.tell(at));
        let watch = MergeWatch { pair: &pair, progress: &progress, ..MergeWatch::default() };
        multiway::merge(&reader, &settings, &[], &watch)
    };
    let hear = |MergeProgress { step, done, of }: MergeProgress| {
        let Some(progress) = &progress else { return Ok(()) };
        let step = match step {
            MergeStep::Describe => "describe",
            MergeStep::Register => "register",
        };
        progress.call1((step, done, of)).map(drop)
    };
    let Merged { places, pairs, voxel_size, inflation, .. } =
        run(py, Place::Pool(pool(py)?), work, hear)?.map_err(exception)?;
    let reasons = places.iter().map(ScanPlace::reason).collect();
    let told = dictionary(py, &Told { places: &places, reasons, voxel_size, inflation })?;
    let pairs = serde_json::to_string(&pairs).map_err(|error| PyRuntimeError::new_err(error.to_string()))?;
    Ok((told, pairs))
}

/// The scans of a folder, in the order of their names.
#[pyfunction]
pub fn scans_in(py: Python<'_>, folder: PathBuf) -> PyResult<Vec<OsString>> {
    let found = run_silent(py, move || upcr_cli::scans_in(&folder))?.map_err(exception)?;
    Ok(found.into_iter().map(PathBuf::into_os_string).collect())
}
