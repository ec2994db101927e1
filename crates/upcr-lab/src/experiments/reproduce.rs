//! Does what experiments plan: trains what is missing, learns on, tests. What has been done stands in the folder and is
//! not done again, so a run that was stopped goes on where it was.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use burn::tensor::Device;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use upcr::net::Network;
use upcr::{Error, Result, Settings};

use super::budget::Budget;
use super::description::{Adapt, Experiment, Measure, Part, Values};
use super::plan::{Cell, Test, Weights};
use super::timing;
use crate::data::pairs::{Mixture, Protocol};
use crate::data::{self, Half, Shapes, Split, seven_scenes};
use crate::eval::methods::EvaluatedMethod;
use crate::eval::metrics::{Tolerance, diameter};
use crate::eval::run::{Row, evaluate_pairs};
use crate::files::write_atomically;
use crate::models::{Learned, LearnedConfig, tensor_file::TensorFile};
use crate::train::{
    Alone, Length, Material, Poses, Trainer, ValidationErrors, Watcher, adapt, write_history,
};

/// Where a reproduction is.
#[derive(Debug, Clone, PartialEq)]
pub struct Progress {
    /// What is done next.
    pub what: String,
    /// Which task it is, from 1, and of how many.
    pub task: usize,
    /// All tasks, those of earlier runs included.
    pub of: usize,
    /// Time to the end, reckoned from what has been done.
    pub left: Option<Duration>,
}

/// Someone who is told of a reproduction's progress and may end it.
pub trait Spectator: Watcher {
    /// Called before every task that has not been done before.
    fn progress(&mut self, progress: &Progress);
}

/// What came of a reproduction.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Results {
    /// Of the program.
    pub version: String,
    /// Name of the budget.
    pub budget_name: String,
    /// The budget.
    pub budget: Budget,
    /// Threads that were used.
    pub threads: usize,
    /// Whether all of the experiments that were asked for are here.
    pub finished: bool,
    /// By experiment.
    pub experiments: Vec<Outcome>,
    /// The networks that have learned for them.
    pub learned: Vec<Lesson>,
}

/// What came of an experiment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// Its name.
    pub name: String,
    /// What it is.
    pub experiment: Experiment,
    /// The data set tested on; none where there is none, and nothing was done.
    pub data: Option<String>,
    /// The data set learned from.
    pub learned_from: Option<String>,
    /// Its measurements.
    pub cells: Vec<Measured>,
}

/// A measurement.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// Name of the setting.
    pub setting: String,
    /// Name of the method.
    pub method: String,
    /// Seed of its network.
    pub seed: u64,
    /// The network's name in the folder.
    pub weights: Option<String>,
    /// What was measured.
    pub values: Values,
}

/// How a network learned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Lesson {
    /// Its name in the folder.
    pub weights: String,
    /// What it learned and from what.
    pub of: Weights,
    /// Clouds to learn from.
    pub shapes: usize,
    /// Steps, of a batch each.
    pub steps: u64,
    /// Time that they took, validation excluded.
    pub seconds: f64,
    /// On clouds that it did not learn from, or on its own where it learned on.
    pub held_out: Option<ValidationErrors>,
    /// Why it could not go on; there are no weights then.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failed: Option<String>,
}

/// A run of experiments.
#[derive(Debug)]
pub struct Reproduction {
    /// Folder of the data sets.
    pub data: PathBuf,
    /// Where everything is kept.
    pub folder: PathBuf,
    /// Name of the budget.
    pub budget_name: String,
    /// What is given to every experiment.
    pub budget: Budget,
    /// What computes.
    pub device: Device,
}

impl Reproduction {
    /// Does what has not been done of the experiments, by name. Where it was stopped, the results are what had been measured
    /// until then. A network that fails to learn leaves its cells empty.
    ///
    /// # Errors
    /// Where an experiment cannot be planned, data cannot be read, the folder cannot be written to or holds what was made
    /// otherwise.
    pub fn run(
        &self,
        experiments: &[(String, Experiment)],
        spectator: &mut dyn Spectator,
    ) -> Result<Results> {
        self.budget.check()?;
        self.claim_folder()?;
        let plans = experiments
            .iter()
            .map(|(_, experiment)| experiment.plan(&self.budget, &self.data))
            .collect::<Result<Vec<_>>>()?;
        let mut tasks = Tasks::of(plans.iter().flatten().flatten());
        let mut store = Store { run: self, shapes: BTreeMap::new() };
        let mut learned = BTreeMap::new();
        let mut outcomes = Vec::new();
        let mut finished = true;
        for ((name, experiment), plan) in experiments.iter().zip(plans) {
            let data = plan.as_ref().and_then(|cells| cells.first()).map(|cell| cell.test.data.clone());
            let mut learners = plan.iter().flatten().filter_map(|cell| cell.test.weights.as_ref());
            let learned_from = learners.next().map(|weights| weights.data.clone());
            let mut cells = Vec::new();
            for Cell { setting, method, seed, test } in plan.into_iter().flatten() {
                let mut told = Told { tasks: &mut tasks, spectator: &mut *spectator, experiment: name };
                if let Some(weights) = test.weights.as_ref().filter(|_| test.measure == Measure::Errors) {
                    let Some(lessons) = store.learn(weights, &mut told)? else {
                        finished = false;
                        break;
                    };
                    learned.extend(lessons.into_iter().map(|lesson| (lesson.weights.clone(), lesson)));
                }
                if told.spectator.stop() {
                    finished = false;
                    break;
                }
                let failed = |weights: &Weights| learned.get(&weights.id()).is_some_and(Lesson::has_failed);
                let values = if test.weights.as_ref().is_some_and(failed) {
                    told.is_done(&test.id());
                    Values::new()
                } else {
                    store.test(&test, &format!("{method}, {setting}"), &mut told)?
                };
                cells.push(Measured { setting, method, seed, weights: test.weights.map(|w| w.id()), values });
            }
            let experiment = experiment.clone();
            outcomes.push(Outcome { name: name.clone(), experiment, data, learned_from, cells });
            if !finished {
                break;
            }
        }
        Ok(Results {
            version: env!("CARGO_PKG_VERSION").into(),
            budget_name: self.budget_name.clone(),
            budget: self.budget.clone(),
            threads: rayon::current_num_threads(),
            finished,
            experiments: outcomes,
            learned: learned.into_values().collect(),
        })
    }

    /// Sees that what stands in the folder was made as it would be made now.
    fn claim_folder(&self) -> Result<()> {
        let made = Made {
            version: env!("CARGO_PKG_VERSION").into(),
            data: self.data.canonicalize().unwrap_or_else(|_| self.data.clone()),
            device: format!("{:?}", self.device),
            threads: rayon::current_num_threads(),
        };
        let path = self.folder.join("made.json");
        match read_json::<Made>(&path)? {
            None => write_json(&path, &made),
            Some(before) if before == made => Ok(()),
            Some(before) => {
                let fields = [
                    ("version", before.version == made.version, before.version),
                    ("data", before.data == made.data, before.data.display().to_string()),
                    ("device", before.device == made.device, before.device),
                    ("threads", before.threads == made.threads, before.threads.to_string()),
                ];
                let other = fields.into_iter().filter(|(_, same, _)| !same);
                let other: Vec<String> = other.map(|(name, _, value)| format!("{name} {value}")).collect();
                let reason =
                    format!("was made with {}; go on with that, or take another folder", other.join(", "));
                Err(Error::Unsupported { path: self.folder.clone(), reason })
            }
        }
    }

    fn weights_folder(&self, weights: &Weights) -> PathBuf {
        self.folder.join("weights").join(weights.id())
    }
}

/// What a folder's contents depend on beside what names them.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Made {
    version: String,
    data: PathBuf,
    device: String,
    /// Times depend on them.
    threads: usize,
}

impl Lesson {
    fn has_failed(&self) -> bool {
        self.failed.is_some()
    }
}

/// The weights of a finished lesson, in its folder, and what is told of it.
const WEIGHTS: &str = "weights.safetensors";
const LESSON: &str = "lesson.json";

/// What has been done, and the data it was done with.
struct Store<'a> {
    run: &'a Reproduction,
    shapes: BTreeMap<(String, Part, bool), Arc<Shapes>>,
}

impl Store<'_> {
    /// Sees that the network has learned, and from what it learns on; the lessons of both. `None` where it was stopped.
    fn learn(&mut self, weights: &Weights, told: &mut Told) -> Result<Option<Vec<Lesson>>> {
        let mut lessons = Vec::new();
        if weights.adaptation.is_some() {
            let Some(before) = self.learn(&weights.unadapted(), told)? else { return Ok(None) };
            let failed = before.iter().find(|lesson| lesson.has_failed()).cloned();
            lessons.extend(before);
            if let Some(failed) = failed {
                told.is_done(&weights.id());
                lessons.push(Lesson { weights: weights.id(), of: weights.clone(), ..failed });
                return Ok(Some(lessons));
            }
        }
        let folder = self.run.weights_folder(weights);
        if let Some(lesson) = read_json(&folder.join(LESSON))? {
            told.is_done(&weights.id());
            lessons.push(lesson);
            return Ok(Some(lessons));
        }
        fs::create_dir_all(&folder).map_err(|source| Error::Io { path: folder.clone(), source })?;
        let learned = match &weights.adaptation {
            None => self.train(weights, &folder, told)?,
            Some(_) => self.adapt(weights, &folder, told)?,
        };
        let Some((network, lesson)) = learned else { return Ok(None) };
        if !lesson.has_failed() {
            write_atomically(&folder.join(WEIGHTS), &network.store().to_bytes()?)?;
        }
        write_json(&folder.join(LESSON), &lesson)?;
        lessons.push(lesson);
        Ok(Some(lessons))
    }

    fn train(
        &mut self,
        weights: &Weights,
        folder: &Path,
        told: &mut Told,
    ) -> Result<Option<(Learned, Lesson)>> {
        let shapes = self.shapes(&weights.data, weights.part, false)?;
        told.starts(&format!("training {weights}"));
        let begun = Instant::now();
        let mut trainer = Trainer::start(weights.training.clone(), folder, &self.run.device)?;
        let done_before = trainer.steps();
        let failed = match trainer.run(&shapes, &mixture(weights), told.spectator) {
            Ok(true) => None,
            Ok(false) => return Ok(None),
            // It would fail again, and the others need not wait for it.
            Err(Error::Diverged { step }) => Some(format!("diverged at step {step}")),
            Err(error) => return Err(error),
        };
        write_history(folder, trainer.history())?;
        told.ends(&weights.id(), trainer.steps() - done_before, begun.elapsed());
        let lesson = Lesson {
            weights: weights.id(),
            of: weights.clone(),
            shapes: shapes.len(),
            steps: trainer.steps(),
            seconds: trainer.seconds(),
            held_out: trainer.history().last().and_then(|event| event.validation).filter(is_finite),
            failed,
        };
        Ok(Some((trainer.network().clone(), lesson)))
    }

    fn adapt(
        &mut self,
        weights: &Weights,
        folder: &Path,
        told: &mut Told,
    ) -> Result<Option<(Learned, Lesson)>> {
        let Some(adaptation) = &weights.adaptation else { return Ok(None) };
        let tested = adaptation.adapt == Adapt::Tested;
        let mut shapes = self.shapes(&adaptation.data, adaptation.setting.shapes, tested)?;
        if tested {
            Arc::make_mut(&mut shapes).truncate(adaptation.pairs.unwrap_or(usize::MAX));
        }
        let config = adaptation.training.clone();
        told.starts(&format!("{weights} learns on"));
        let begun = Instant::now();
        let before = self.load(&weights.unadapted())?;
        let material = Material {
            parts: vec![shapes.clone()],
            mixture: vec![(adaptation.setting.protocol(self.run.budget.points), 1.0)],
            poses: if tested { Poses::Fixed } else { Poses::Fresh },
        };
        let found = adapt(&before, &material, config, folder, &mut Alone, told.spectator)?;
        if !found.finished {
            return Ok(None);
        }
        told.ends(&weights.id(), found.steps, begun.elapsed());
        let lesson = Lesson {
            weights: weights.id(),
            of: weights.clone(),
            shapes: shapes.len(),
            steps: found.steps,
            seconds: found.seconds,
            held_out: Some(found.errors[usize::from(found.helped)]).filter(is_finite),
            failed: None,
        };
        Ok(Some((found.network, lesson)))
    }

    fn load(&self, weights: &Weights) -> Result<Learned> {
        let path = self.run.weights_folder(weights).join(WEIGHTS);
        let bytes = fs::read(&path).map_err(|source| Error::Io { path: path.clone(), source })?;
        let file = TensorFile::from_bytes(&bytes, &path)?;
        Learned::restore(&file, &path, &self.run.device.clone().autodiff())
    }

    fn test(&mut self, test: &Test, label: &str, told: &mut Told) -> Result<Values> {
        let path = self.run.folder.join("tests").join(format!("{}.json", test.id()));
        if let Some(values) = read_json(&path)? {
            told.is_done(&test.id());
            return Ok(values);
        }
        told.starts(&format!("testing {label}"));
        let begun = Instant::now();
        let values = match test.measure {
            Measure::Errors => self.errors(test)?,
            Measure::Time => timing::times(test)?,
        };
        let folder = self.run.folder.join("tests");
        fs::create_dir_all(&folder).map_err(|source| Error::Io { path: folder, source })?;
        write_json(&path, &values)?;
        told.ends(&test.id(), 1, begun.elapsed());
        Ok(values)
    }

    fn errors(&mut self, test: &Test) -> Result<Values> {
        let method = match &test.weights {
            None => EvaluatedMethod::by_name(test.run.as_deref().unwrap_or_default())?,
            Some(weights) => method_of(self.load(weights)?, test.run.as_deref())?,
        };
        let settings = Settings::default();
        let row = match test.setting.frames_apart {
            None => {
                let shapes = self.shapes(&test.data, test.setting.shapes, true)?;
                let protocol = test.setting.protocol(test.points);
                let count = some_of(shapes.len(), test)?;
                let pair = |item: usize| protocol.pair(&shapes.points(item), item as u64);
                let tolerance = |pair: &data::pairs::Pair| Tolerance::object(diameter(&pair.source.points));
                evaluate_pairs(&method, &settings, count, pair, tolerance, &mut |_| {})?
            }
            Some(gap) => {
                let (frames, _) = seven_scenes::frames(&self.run.data.join(&test.data), Split::All)?;
                let pairs = seven_scenes::frame_pairs(&frames, gap);
                let count = some_of(pairs.len(), test)?;
                // Evenly over the sequences.
                let pair = |item: usize| seven_scenes::read_pair(pairs[item * pairs.len() / count]);
                evaluate_pairs(&method, &settings, count, pair, |_| Tolerance::INDOOR, &mut |_| {})?
            }
        };
        Ok(values(&row))
    }

    /// The clouds of a data set that are for tests, or those that are to be learned from.
    fn shapes(&mut self, data: &str, part: Part, for_tests: bool) -> Result<Arc<Shapes>> {
        let key = (data.to_owned(), part, for_tests);
        if let Some(shapes) = self.shapes.get(&key) {
            return Ok(shapes.clone());
        }
        let path = self.run.data.join(data);
        let shapes = match (part, for_tests) {
            (Part::UnseenClouds, true) => data::open(&path, Split::Test)?,
            (Part::UnseenClouds, false) => data::open(&path, Split::Train)?,
            (Part::UnseenCategories, true) => data::open(&path, Split::All)?.categories(Half::Second),
            (Part::UnseenCategories, false) => data::open(&path, Split::All)?.categories(Half::First),
        };
        let shapes = Arc::new(shapes);
        self.shapes.insert(key, shapes.clone());
        Ok(shapes)
    }
}

/// A file has no other numbers.
fn is_finite(errors: &ValidationErrors) -> bool {
    [errors.loss, errors.mae_r_deg, errors.mae_t, errors.recall].iter().all(|value| value.is_finite())
}

/// A trained network as a method: alone, or within one of `upcr eval`.
fn method_of(network: Learned, run: Option<&str>) -> Result<EvaluatedMethod> {
    match (&network, run) {
        (Learned::Upcr(_), run) => {
            let name = run.unwrap_or("upcr");
            let network = Network::from_safetensors(&network.store().to_bytes()?)?;
            Ok(EvaluatedMethod::by_name(name)?.with_network(name, network))
        }
        (_, None) => Ok(EvaluatedMethod::learned("network", network)),
        (_, Some(name)) => {
            let reason = format!("{name} takes no network of another kind than UPCR's");
            Err(Error::InvalidSetting { name: "experiment", reason })
        }
    }
}

/// How many of so many pairs are tested on.
fn some_of(pairs: usize, test: &Test) -> Result<usize> {
    if pairs == 0 {
        let pairs = match test.setting.frames_apart {
            Some(gap) => format!("frames that are {gap} apart"),
            None => "shapes".into(),
        };
        let reason = format!("{} has no {pairs} to test on", test.data);
        return Err(Error::InvalidSetting { name: "experiment", reason });
    }
    Ok(pairs.min(test.pairs.unwrap_or(usize::MAX)))
}

/// Pairs to learn from: each of the overlaps as often.
fn mixture(weights: &Weights) -> Mixture {
    weights.overlaps.iter().map(|&coverage| (Protocol { coverage, ..Protocol::CONSISTENT }, 1.0)).collect()
}

/// A row's numbers by their names.
fn values(row: &Row) -> Values {
    let fields = match serde_json::to_value(row) {
        Ok(serde_json::Value::Object(fields)) => fields,
        _ => serde_json::Map::new(),
    };
    fields.into_iter().filter_map(|(name, value)| Some((name, value.as_f64()?))).collect()
}

/// What tasks of one kind have in common: they take so long for each unit of work.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Pace {
    kind: String,
    learns: bool,
    work: u64,
}

/// What tasks of a kind have taken.
#[derive(Debug, Clone, Copy, Default)]
struct Spent {
    seconds: f64,
    work: u64,
    tasks: u64,
    learning: bool,
}

impl Pace {
    fn of(weights: &Weights) -> Self {
        let steps = |length: Length| match length {
            Length::Steps(steps) => steps,
            // Of a data set of usual size.
            Length::Epochs(epochs) => epochs.saturating_mul(100),
        };
        let config = weights.last();
        let work = config.stages.iter().map(|stage| steps(stage.length)).sum();
        let invariant = match &config.network {
            LearnedConfig::Upcr(config) => format!("{:?}", config.invariant),
            _ => String::new(),
        };
        Self { kind: format!("{} {invariant} learns", weights.network), learns: true, work }
    }

    fn of_test(test: &Test) -> Self {
        let network = test.weights.as_ref().map_or("", |weights| &weights.network);
        let frames = if test.setting.frames_apart.is_some() { "frames" } else { "shapes" };
        Self { kind: format!("{:?} {network} {frames} test", test.run), learns: false, work: 1 }
    }
}

/// All that is to be done, and how long what is done has taken.
#[derive(Default)]
struct Tasks {
    /// By name, as [`Weights::id`] and [`Test::id`] give it.
    open: BTreeMap<String, Pace>,
    of: usize,
    /// By kind.
    spent: BTreeMap<String, Spent>,
}

impl Tasks {
    fn of<'a>(cells: impl Iterator<Item = &'a Cell>) -> Self {
        let mut open = BTreeMap::new();
        for Cell { test, .. } in cells {
            if let Some(weights) = test.weights.as_ref().filter(|_| test.measure == Measure::Errors) {
                let before = weights.unadapted();
                open.insert(before.id(), Pace::of(&before));
                open.insert(weights.id(), Pace::of(weights));
            }
            open.insert(test.id(), Pace::of_test(test));
        }
        Self { of: open.len(), open, spent: BTreeMap::new() }
    }

    /// Time to the end: of kinds of which one has been done, at their pace; of others as much as learning, or a test,
    /// takes on the average. `None` before there is any.
    fn time_left(&self) -> Option<Duration> {
        let mean = |learns: bool| {
            let of_sort = || self.spent.values().filter(|spent| spent.learning == learns);
            let tasks = of_sort().map(|spent| spent.tasks).sum::<u64>();
            (tasks > 0).then(|| of_sort().map(|spent| spent.seconds).sum::<f64>() / tasks as f64)
        };
        let means = [mean(false), mean(true)];
        let seconds = self.open.values().map(|pace| match self.spent.get(&pace.kind) {
            Some(spent) => Some(spent.seconds * pace.work as f64 / spent.work.max(1) as f64),
            None => means[usize::from(pace.learns)],
        });
        Duration::try_from_secs_f64(seconds.sum::<Option<f64>>()?).ok()
    }
}

/// Who is told of an experiment's tasks.
struct Told<'a> {
    tasks: &'a mut Tasks,
    spectator: &'a mut dyn Spectator,
    experiment: &'a str,
}

impl Told<'_> {
    /// Says what is done next.
    fn starts(&mut self, what: &str) {
        self.spectator.progress(&Progress {
            what: format!("{}: {what}", self.experiment),
            task: self.tasks.of - self.tasks.open.len() + 1,
            of: self.tasks.of,
            left: self.tasks.time_left(),
        });
    }

    /// Crosses a task off that had been done before.
    fn is_done(&mut self, id: &str) {
        self.tasks.open.remove(id);
    }

    /// Crosses a task off that took so long for so much work.
    fn ends(&mut self, id: &str, work: u64, time: Duration) {
        if let Some(pace) = self.tasks.open.remove(id).filter(|_| work > 0) {
            let spent = self.tasks.spent.entry(pace.kind).or_default();
            spent.learning = pace.learns;
            spent.seconds += time.as_secs_f64();
            spent.work += work;
            spent.tasks += 1;
        }
    }
}

fn write_json(path: &Path, value: &impl Serialize) -> Result<()> {
    let text = serde_json::to_string_pretty(value).map_err(|e| Error::Malformed {
        path: path.into(),
        format: "JSON",
        reason: e.to_string(),
    })?;
    write_atomically(path, text.as_bytes())
}

/// What a file holds; `None` where there is none.
fn read_json<T: DeserializeOwned>(path: &Path) -> Result<Option<T>> {
    match fs::read(path) {
        Ok(bytes) => serde_json::from_slice(&bytes).map(Some).map_err(|e| Error::Malformed {
            path: path.into(),
            format: "JSON",
            reason: e.to_string(),
        }),
        Err(source) if source.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(source) => Err(Error::Io { path: path.into(), source }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_left_is_reckoned_from_what_has_been_done() {
        let pace = |kind: &str, learns: bool, work: u64| Pace { kind: kind.into(), learns, work };
        let open = [
            ("long", pace("upcr", true, 400)),
            ("other", pace("dcp", true, 30)),
            ("test", pace("icp", false, 1)),
        ];
        let mut tasks = Tasks {
            open: open.map(|(id, pace)| (id.to_owned(), pace)).into(),
            of: 5,
            spent: BTreeMap::new(),
        };
        assert_eq!(tasks.time_left(), None);
        let done = |learning: bool, work: u64| Spent { seconds: 10.0, work, tasks: 1, learning };
        tasks.spent.insert("upcr".into(), done(true, 100));
        // Nothing is known of tests yet.
        assert_eq!(tasks.time_left(), None);
        tasks.spent.insert("fgr".into(), done(false, 1));
        // The long one takes four times what its kind took, the others what theirs take on the average.
        assert_eq!(tasks.time_left(), Some(Duration::from_secs(40 + 10 + 10)));
    }
}
