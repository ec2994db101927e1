//! Label-free adaptation: what `upcr adapt` of the command line does.

use std::num::NonZeroUsize;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Sender, channel};

use numpy::{PyArray1, PyReadonlyArray1};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use upcr_cli::Pairs;
use upcr_lab::Device;
use upcr_lab::data::{self, Shapes, Split, pairs::POINTS};
use upcr_lab::models::{Learned, tensor_file::TensorFile};
use upcr_lab::train::{
    self, ADAPTATION_EPOCHS, Adaptation, Alone, Event, Material, Poses, Team, TrainingConfig, Watcher,
};

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
    parts: Option<usize>,
    checkpoint_seconds: Option<f64>,
}

/// One of several that learn together, who is given the clouds of its own parts of every batch.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Membership {
    /// Index of the first of its parts.
    first_part: usize,
    /// How many clouds the parts before have.
    clouds_before: usize,
    /// How many clouds each of its parts has.
    sizes: Vec<usize>,
    /// Called with a list of arrays, one of each of its parts; gives all parts'.
    gather: Py<PyAny>,
}

/// Where a member's clouds are in the whole, without what Python is called for.
struct Share {
    first_part: usize,
    clouds_before: usize,
    sizes: Vec<usize>,
}

/// What to learn from: a folder or data set, or clouds.
#[derive(FromPyObject)]
pub enum Clouds {
    #[pyo3(transparent)]
    Folder(PathBuf),
    #[pyo3(transparent)]
    Each(Vec<Input>),
}

/// What the learning thread says.
enum Told {
    /// How far it is, and seconds to the end.
    Event(Event, f64),
    /// Rows of the own parts, for which it waits for all parts'.
    Gather(Vec<Vec<f64>>, Sender<Vec<Vec<f64>>>),
}

/// Learns on from `weights`; `progress` is called with an event's fields. Returns the fields of what came of it.
#[pyfunction]
#[pyo3(signature = (clouds, weights, folder, options, progress, member))]
pub fn adapt<'py>(
    py: Python<'py>,
    clouds: Clouds,
    weights: &Bound<'py, Model>,
    folder: PathBuf,
    options: Options,
    progress: Option<Bound<'py, PyAny>>,
    member: Option<Membership>,
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
    let (share, gather) = match member {
        None => (None, None),
        Some(Membership { first_part, clouds_before, sizes, gather }) => {
            (Some(Share { first_part, clouds_before, sizes }), Some(gather))
        }
    };
    let work = move |caller: &Caller<Told>| -> PyResult<(Adaptation, Vec<u8>)> {
        let learn = || -> upcr::Result<_> {
            let parts = clouds.parts(options.parts.unwrap_or(1), share.as_ref())?;
            let material = Material {
                parts,
                mixture: pairs.mixture(options.partial),
                poses: if options.fixed_pairs { Poses::Fixed } else { Poses::Fresh },
            };
            let done = match share {
                Some(share) => {
                    learn(&material, &weights, &folder, &options, &mut Member { share, caller }, caller)
                }
                None => learn(&material, &weights, &folder, &options, &mut Alone, caller),
            }?;
            let bytes = done.network.store().to_bytes()?;
            Ok((done, bytes))
        };
        let done = match threads {
            Some(threads) => own_pool(threads.get())?.install(learn),
            None => learn(),
        };
        done.map_err(exception)
    };
    let hear = |told| match told {
        Told::Event(event, left) => {
            let Some(progress) = &progress else { return Ok(()) };
            let event = dictionary(py, &event)?;
            event.set_item("seconds_left", left)?;
            progress.call1((event,)).map(drop)
        }
        Told::Gather(own, reply) => {
            let Some(gather) = &gather else { return Ok(()) };
            let own: Vec<_> = own.into_iter().map(|row| PyArray1::from_vec(py, row)).collect();
            let all: Vec<PyReadonlyArray1<'_, f64>> = gather.bind(py).call1((own,))?.extract()?;
            let all = all.iter().map(|row| Ok(row.as_slice()?.to_vec())).collect::<PyResult<_>>()?;
            // Who has ended needs no answer.
            drop(reply.send(all));
            Ok(())
        }
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
    /// The shapes of every part that is learned from here: all parts, or a member's own.
    fn parts(&self, parts: usize, share: Option<&Share>) -> upcr::Result<Vec<Arc<Shapes>>> {
        let shapes = match self {
            Self::Folder(path) => data::open(path, Split::All)?,
            Self::Each(clouds) => {
                let clouds: Vec<_> = clouds
                    .iter()
                    .map(|cloud| Ok(Arc::unwrap_or_clone(cloud.get()?)))
                    .collect::<upcr::Result<_>>()?;
                Shapes::from_clouds(&clouds, share.map_or(0, |share| share.clouds_before))?
            }
        };
        let Some(share) = share else {
            return Ok(shapes.in_parts(parts.max(1)).into_iter().map(Arc::new).collect());
        };
        let mut rest = shapes;
        let own = share.sizes.iter().map(|&size| {
            let later = rest.split_off(size);
            Arc::new(std::mem::replace(&mut rest, later))
        });
        Ok(own.collect())
    }
}

fn learn(
    material: &Material,
    weights: &[u8],
    folder: &Path,
    options: &Options,
    team: &mut dyn Team,
    caller: &Caller<Told>,
) -> upcr::Result<Adaptation> {
    let name = Path::new("weights");
    let network =
        Learned::restore(&TensorFile::from_bytes(weights, name)?, name, &Device::flex().autodiff())?;
    let (points, epochs) = (options.points.unwrap_or(POINTS), options.epochs.unwrap_or(ADAPTATION_EPOCHS));
    let mut config = TrainingConfig::adaptation(&network, points, epochs);
    config.learning_rate = options.learning_rate.unwrap_or(config.learning_rate);
    config.seed = options.seed.unwrap_or(config.seed);
    config.parts = options.parts.unwrap_or(config.parts);
    config.checkpoint_seconds = options.checkpoint_seconds.unwrap_or(config.checkpoint_seconds);
    train::adapt(&network, material, config, folder, team, &mut Teller(caller))
}

/// Tells whoever waits.
struct Teller<'a>(&'a Caller<Told>);

impl Watcher for Teller<'_> {
    fn event(&mut self, event: &Event, clouds_left: u64) {
        self.0.tell(Told::Event(*event, event.time_left(clouds_left).as_secs_f64()));
    }

    fn stop(&mut self) -> bool {
        self.0.is_gone()
    }
}

/// A member whose rows go through Python to the others.
struct Member<'a> {
    share: Share,
    caller: &'a Caller<Told>,
}

impl Team for Member<'_> {
    fn own(&self, _: usize) -> Range<usize> {
        self.share.first_part..self.share.first_part + self.share.sizes.len()
    }

    fn gather(&mut self, own: Vec<Vec<f64>>) -> upcr::Result<Vec<Vec<f64>>> {
        let (reply, all) = channel();
        self.caller.tell(Told::Gather(own, reply));
        let lost = |_| upcr::Error::InvalidSetting { name: "team", reason: "a member is lost".into() };
        all.recv().map_err(lost)
    }
}
