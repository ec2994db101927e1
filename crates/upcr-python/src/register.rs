//! Registration: one pair, or many.

use std::collections::HashMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;

use numpy::PyArray2;
use pyo3::exceptions::PyIndexError;
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use serde::Serialize;
use upcr::{
    Alternative, Evidence, FreeDirection, PointCloud, Progress, Registration, Rigid, Settings, Timings,
    Watch, register_watched,
};
use upcr_lab::data::share;

use crate::call::{Caller, Place, own_pool, pool, run};
use crate::cloud::{Input, array, cloud_exception, viewpoint};
use crate::objects::{dictionary, object};
use crate::settings::{pose, settings};

/// Points of a cloud that a result keeps for its picture, at most.
const PICTURED: usize = 600;

/// A result with what Python is given of it beside its numbers.
struct Found {
    registration: Registration,
    more: String,
    /// Points of the source and of the target.
    pictured: [Vec<[f64; 3]>; 2],
}

/// What Python makes a result of: its fields, the JSON of those that few look at, and points of the source and the target.
type Parts<'py> = (Bound<'py, PyDict>, String, Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<f64>>);

/// The fields that cost more to make than the call has over, and are made where they are looked at.
#[derive(Serialize)]
struct More<'a> {
    caveats: Vec<String>,
    free_directions: &'a [FreeDirection],
    /// The free directions in words.
    sentences: Vec<String>,
    alternatives: &'a [Alternative],
    evidence: &'a Evidence,
    points_used: [usize; 2],
    settings: &'a Settings,
    timings_ms: &'a Timings,
}

impl Found {
    fn new(registration: Registration, source: &PointCloud, target: &PointCloud) -> Self {
        let more = More {
            caveats: registration.reasons.iter().map(ToString::to_string).collect(),
            free_directions: &registration.free_directions,
            sentences: registration.free_directions.iter().map(ToString::to_string).collect(),
            alternatives: &registration.alternatives,
            evidence: &registration.evidence,
            points_used: registration.points_used,
            settings: &registration.settings,
            timings_ms: &registration.timings_ms,
        };
        // Names, numbers and lists of them all have a JSON form.
        let more = serde_json::to_string(&more).unwrap_or_default();
        Self { registration, more, pictured: [source, target].map(spread) }
    }

    fn into_parts(self, py: Python<'_>) -> PyResult<Parts<'_>> {
        let Self { registration: found, more, pictured: [source, target] } = self;
        let fields = PyDict::new(py);
        let pose = array(py, found.T_target_source.to_rows().to_vec())?;
        fields.set_item(intern!(py, "T_target_source"), pose)?;
        fields.set_item(intern!(py, "fitness"), found.fitness)?;
        fields.set_item(intern!(py, "inlier_rmse"), found.inlier_rmse)?;
        fields.set_item(intern!(py, "num_inliers"), found.num_inliers)?;
        fields.set_item(intern!(py, "converged"), found.converged)?;
        fields.set_item(intern!(py, "iterations"), found.iterations)?;
        fields.set_item(intern!(py, "probability"), found.probability)?;
        fields.set_item(intern!(py, "covariance"), array(py, found.covariance.to_vec())?)?;
        fields.set_item(intern!(py, "reasons"), object(py, &found.reasons)?)?;
        fields.set_item(intern!(py, "source_scale"), found.source_scale)?;
        fields.set_item(intern!(py, "method"), object(py, &found.method)?)?;
        fields.set_item(intern!(py, "voxel_size"), found.voxel_size)?;
        fields.set_item(intern!(py, "is_trustworthy"), found.is_trustworthy())?;
        Ok((fields, more, array(py, source)?, array(py, target)?))
    }
}

/// Points from all over a cloud: of every so many in its order one, at changing places, as scanners' orders have periods.
fn spread(cloud: &PointCloud) -> Vec<[f64; 3]> {
    let (all, kept) = (cloud.len(), cloud.len().min(PICTURED));
    let place = |i: usize| {
        let near = share(all, i, kept);
        near.start + i.wrapping_mul(0x9e37_79b9) % near.len()
    };
    (0..kept).map(|i| cloud.points[place(i)]).collect()
}

/// Registers one pair; `progress` is called with a stage, a method and the share that is done.
#[pyfunction]
#[pyo3(signature = (source, target, given, source_viewpoint, target_viewpoint, progress))]
pub fn register<'py>(
    py: Python<'py>,
    source: Input,
    target: Input,
    given: &Bound<'py, PyDict>,
    source_viewpoint: Option<[f64; 3]>,
    target_viewpoint: Option<[f64; 3]>,
    progress: Option<Bound<'py, PyAny>>,
) -> PyResult<Parts<'py>> {
    let settings = settings(given)?;
    let viewpoints =
        [viewpoint("source_viewpoint", source_viewpoint)?, viewpoint("target_viewpoint", target_viewpoint)?];
    let told = progress.is_some();
    let work = move |caller: &Caller<Progress>| {
        let found = || {
            let (source, target) = (source.seen_from(viewpoints[0])?, target.seen_from(viewpoints[1])?);
            let (cancelled, hear) = (|| caller.is_gone(), |progress| caller.tell(progress));
            let watch =
                Watch { cancelled: Some(&cancelled), progress: told.then_some(&hear), ..Watch::default() };
            let registration = register_watched(&source, &target, &settings, &watch)?;
            Ok(Found::new(registration, &source, &target))
        };
        found().map_err(|error| cloud_exception(error, &source, &target))
    };
    let hear = |at: Progress| {
        let Some(progress) = &progress else { return Ok(()) };
        let at = dictionary(py, &at)?;
        let field = |name| at.as_any().get_item(name);
        progress.call1((field("stage")?, field("method")?, field("done")?)).map(drop)
    };
    run(py, Place::Pool(pool(py)?), work, hear)??.into_parts(py)
}

/// A pair of a batch with its own first guess, where it has one.
struct Pair {
    /// Its place in the list.
    number: usize,
    source: Arc<Input>,
    target: Arc<Input>,
    init: Option<Rigid>,
}

impl Pair {
    fn register(&self, settings: &Settings, gone: &(dyn Fn() -> bool + Sync)) -> upcr::Result<Found> {
        let told = settings.threads;
        let settings = Settings { init: self.init.or(settings.init), threads: None, ..settings.clone() };
        let (source, target) = (self.source.get()?, self.target.get()?);
        let watch = Watch { cancelled: Some(gone), ..Watch::default() };
        let mut registration = register_watched(&source, &target, &settings, &watch)?;
        registration.settings.threads = told;
        Ok(Found::new(registration, &source, &target))
    }
}

/// The exception with a note of the pair's number, where this Python has notes.
fn noted(py: Python<'_>, error: PyErr, number: usize) -> PyErr {
    drop(error.value(py).call_method1("add_note", (format!("pair {number}"),)));
    error
}

/// Registers numbered pairs of places in `clouds`, several at a time; results and exceptions come in the pairs' order. `progress`
/// is called with the number of pairs done. Where `raises`, the first pair's exception ends it.
#[pyfunction]
#[pyo3(signature = (clouds, pairs, given, raises, progress))]
pub fn register_batch<'py>(
    py: Python<'py>,
    clouds: Vec<Bound<'py, PyAny>>,
    pairs: Vec<(usize, usize, usize, Option<Bound<'py, PyAny>>)>,
    given: &Bound<'py, PyDict>,
    raises: bool,
    progress: Option<Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyList>> {
    let settings = settings(given)?;
    let mut inputs = HashMap::new();
    let mut input = |place: usize| -> PyResult<Arc<Input>> {
        if let Some(input) = inputs.get(&place) {
            return Ok(Arc::clone(input));
        }
        let cloud = clouds.get(place).ok_or_else(|| PyIndexError::new_err(place))?;
        let input = Arc::new(cloud.extract::<Input>()?);
        inputs.insert(place, input.clone());
        Ok(input)
    };
    let mut ready = Vec::new();
    // Why a pair cannot be looked at, where it cannot.
    let mut refused = Vec::new();
    for (number, source, target, init) in pairs {
        match init.map(|init| pose("init", &init)).transpose() {
            Ok(init) => {
                ready.push(Pair { number, source: input(source)?, target: input(target)?, init });
                refused.push(None);
            }
            Err(error) if raises => return Err(noted(py, error, number)),
            Err(error) => refused.push(Some(error)),
        }
    }
    let pairs = Arc::new(ready);
    let threads = settings
        .threads
        .map_or_else(|| pool(py).map(rayon::ThreadPool::current_num_threads), |n| Ok(n.get()))?;
    let batch = Batch { pairs: pairs.clone(), settings, threads, raises };
    let mut done = 0_usize;
    let hear = |()| {
        done += 1;
        progress.as_ref().map_or(Ok(()), |progress| progress.call1((done,)).map(drop))
    };
    let found = run(py, Place::Thread, move |caller| batch.run(caller), hear)??;
    let results = PyList::empty(py);
    let mut found = found.into_iter().zip(pairs.iter());
    for error in refused {
        if let Some(error) = error {
            results.append(error.into_value(py))?;
            continue;
        }
        let Some((found, pair)) = found.next() else { break };
        match found {
            Some(Ok(found)) => results.append(found.into_parts(py)?)?,
            Some(Err(error)) => {
                let error = cloud_exception(error, &pair.source, &pair.target);
                if raises {
                    return Err(noted(py, error, pair.number));
                }
                results.append(error.into_value(py))?;
            }
            // Left out behind an error that is raised.
            None => break,
        }
    }
    Ok(results)
}

struct Batch {
    pairs: Arc<Vec<Pair>>,
    settings: Settings,
    threads: usize,
    raises: bool,
}

impl Batch {
    /// Whole pairs on threads of their own: none waits for another's steps, and a time limit is each pair's. Where there are
    /// fewer pairs than threads, a pair has several.
    fn run(self, caller: &Caller<()>) -> PyResult<Vec<Option<upcr::Result<Found>>>> {
        let Self { pairs, settings, threads, raises } = self;
        let workers = threads.min(pairs.len()).max(1);
        let next = AtomicUsize::new(0);
        // Pairs before the first that failed are done, whatever the order of things.
        let first_failed = AtomicUsize::new(usize::MAX);
        let found: Mutex<Vec<_>> = Mutex::new(pairs.iter().map(|_| None).collect());
        let is_gone = || caller.is_gone();
        let work = || {
            while !caller.is_gone() {
                let i = next.fetch_add(1, Ordering::Relaxed);
                let Some(pair) = pairs.get(i) else { break };
                if i > first_failed.load(Ordering::Relaxed) {
                    break;
                }
                let one = pair.register(&settings, &is_gone);
                if one.is_err() && raises {
                    first_failed.fetch_min(i, Ordering::Relaxed);
                }
                found.lock().unwrap_or_else(PoisonError::into_inner)[i] = Some(one);
                caller.tell(());
            }
        };
        let pools: Vec<_> =
            (0..workers).map(|w| own_pool(share(threads, w, workers).len())).collect::<PyResult<_>>()?;
        thread::scope(|scope| {
            for pool in &pools {
                scope.spawn(|| pool.install(work));
            }
        });
        Ok(found.into_inner().unwrap_or_else(PoisonError::into_inner))
    }
}
