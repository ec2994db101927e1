//! Label-free adaptation: what `upcr adapt` of the command line does.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use pyo3::prelude::*;
use pyo3::types::PyDict;
use upcr_cli::Pairs;
use upcr_lab::Device;
use upcr_lab::data::{self, Shapes, Split, pairs::POINTS};
use upcr_lab::models::{Learned, tensor_file::TensorFile};
use upcr_lab::train::{self, ADAPTATION_EPOCHS, Adaptation, Event, Poses, TrainingConfig, Watcher};

use crate::call::{Caller, Place, own_pool, pool, run};
use crate::cloud::Input;
use crate::errors::{exception, setting};
use crate::model::Model;
use crate::objects::dictionary;
use crate::settings::chosen;

/// What learning leaves open, where it is told.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Options {
    pairs: Option<String>,
    partial: bool,
    fixed_pairs: bool,
    epochs: Option<u64>,
    points: Option<usize>,
    learning_rate: Option<f64>,
    seed: Option<u64>,
    threads: Option<NonZeroUsize>,
}

/// What to learn from: a folder or data set, or clouds.
#[derive(FromPyObject)]
pub enum Clouds {
    #[pyo3(transparent)]
    Folder(PathBuf),
    #[pyo3(transparent)]
    Each(Vec<Input>),
}

/// Learns on from `weights`; `progress` is called with an event's fields. Returns the fields of what came of it.
#[pyfunction]
#[pyo3(signature = (clouds, weights, folder, options, progress))]
pub fn adapt<'py>(
    py: Python<'py>,
    clouds: Clouds,
    weights: &Bound<'py, Model>,
    folder: PathBuf,
    options: Options,
    progress: Option<Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let pairs = match &options.pairs {
        None => Pairs::ADAPTATION,
        Some(name) => chosen("pairs", name)?,
    };
    if options.epochs == Some(0) {
        return Err(setting("epochs", "at least one is needed"));
    }
    let threads = options.threads;
    let weights = weights.get().weights.clone();
    let work = move |caller: &Caller<(Event, f64)>| -> PyResult<(Adaptation, Vec<u8>)> {
        let learn = || -> upcr::Result<_> {
            let shapes = Arc::new(clouds.shapes()?);
            let done = learn(&shapes, &weights, &folder, pairs, &options, caller)?;
            let bytes = done.network.store().to_bytes()?;
            Ok((done, bytes))
        };
        let done = match threads {
            Some(threads) => own_pool(threads.get())?.install(learn),
            None => learn(),
        };
        done.map_err(exception)
    };
    let hear = |(event, left): (Event, f64)| {
        let Some(progress) = &progress else { return Ok(()) };
        let event = dictionary(py, &event)?;
        event.set_item("seconds_left", left)?;
        progress.call1((event,)).map(drop)
    };
    let (done, bytes) = run(py, Place::Pool(pool(py)?), work, hear)??;
    let fields = PyDict::new(py);
    fields.set_item("model", Model::from_bytes(py, bytes)?)?;
    fields.set_item("helped", done.helped)?;
    let [before, after] = &done.errors;
    fields.set_item("before", dictionary(py, before)?)?;
    fields.set_item("after", dictionary(py, after)?)?;
    fields.set_item("steps", done.steps)?;
    fields.set_item("seconds", done.seconds)?;
    Ok(fields)
}

impl Clouds {
    fn shapes(&self) -> upcr::Result<Shapes> {
        match self {
            Self::Folder(path) => data::open(path, Split::All),
            Self::Each(clouds) => {
                let clouds: Vec<_> = clouds
                    .iter()
                    .map(|cloud| Ok(Arc::unwrap_or_clone(cloud.get()?)))
                    .collect::<upcr::Result<_>>()?;
                Shapes::from_clouds(&clouds)
            }
        }
    }
}

fn learn(
    shapes: &Arc<Shapes>,
    weights: &[u8],
    folder: &Path,
    pairs: Pairs,
    options: &Options,
    caller: &Caller<(Event, f64)>,
) -> upcr::Result<Adaptation> {
    let name = Path::new("weights");
    let network =
        Learned::restore(&TensorFile::from_bytes(weights, name)?, name, &Device::flex().autodiff())?;
    let (points, epochs) = (options.points.unwrap_or(POINTS), options.epochs.unwrap_or(ADAPTATION_EPOCHS));
    let mut config = TrainingConfig::adaptation(&network, points, epochs);
    config.learning_rate = options.learning_rate.unwrap_or(config.learning_rate);
    config.seed = options.seed.unwrap_or(config.seed);
    let mixture = pairs.mixture(options.partial);
    let poses = if options.fixed_pairs { Poses::Fixed } else { Poses::Fresh };
    train::adapt(&network, shapes, &mixture, poses, config, folder, &mut Teller(caller))
}

/// Tells whoever waits.
struct Teller<'a>(&'a Caller<(Event, f64)>);

impl Watcher for Teller<'_> {
    fn event(&mut self, event: &Event, clouds_left: u64) {
        self.0.tell((*event, event.time_left(clouds_left).as_secs_f64()));
    }

    fn stop(&mut self) -> bool {
        self.0.is_gone()
    }
}
