//! The training loop.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use burn::optim::{AdamConfig, GradientsParams, ModuleOptimizer};
use burn::tensor::Device;
use upcr::{Error, Result};

use super::checkpoint::{self, State};
use super::config::{Length, Stage, TrainingConfig};
use super::history::{Event, History, ValidationErrors, Watcher};
use super::team::{Alone, Lesson, Team, mean};
pub use crate::data::loader::Poses;
use crate::data::loader::{Example, Loader, Plan, Position, Training};
use crate::data::pairs::Mixture;
use crate::data::{Shapes, share};
use crate::eval::metrics::{PoseErrors, Recall, Tolerance};
use crate::models::tensor_file::TensorFile;
use crate::models::{Batch, Learned, LearnedConfig};

/// Share of a batch in the running statistics of batch norm.
const STATISTICS_SHARE: f64 = 0.1;
/// Time between events.
const EVENT_EVERY: Duration = Duration::from_secs(10);
/// Threads that make batches: neighbours and features cost far less than a step.
const LOADER_THREADS: usize = 1;
/// The file in a run's folder with which it goes on.
const CHECKPOINT: &str = "checkpoint.safetensors";
/// Diameter of shapes in the unit sphere.
const DIAMETER: f64 = 2.0;

/// A training run.
pub struct Trainer {
    folder: PathBuf,
    network: Learned,
    optimizer: ModuleOptimizer,
    state: State,
}

/// Pairs with known poses, to see how far a network has come.
#[derive(Debug)]
pub struct Validation {
    batches: Vec<Batch>,
}

impl Validation {
    /// The mixture's own pairs of every shape.
    ///
    /// # Errors
    /// Where a shape has too few points.
    pub fn new(shapes: &Shapes, mixture: &Mixture, points: usize, config: &LearnedConfig) -> Result<Self> {
        const BATCH: usize = 32;
        let mut batches = Vec::new();
        for (protocol, _) in mixture {
            let protocol = protocol.keeping(points);
            let items: Vec<usize> = (0..shapes.len()).collect();
            for items in items.chunks(BATCH) {
                let mut pairs = Vec::new();
                let mut truths = Vec::new();
                for &item in items {
                    let pair = protocol.pair(&shapes.points(item), item as u64)?;
                    let [source, target] = [&pair.source, &pair.target]
                        .map(|cloud| cloud.points.iter().map(|p| p.map(|v| v as f32)).collect());
                    pairs.push(config.input(source, target)?);
                    truths.push(pair.T_target_source);
                }
                batches.push(Batch::new(pairs, truths));
            }
        }
        Ok(Self { batches })
    }
}

/// Errors of a network, with its running statistics.
///
/// # Errors
/// Where the pairs were made for another network.
pub fn validate(network: &Learned, validation: &Validation) -> Result<ValidationErrors> {
    let mut poses = Vec::new();
    let mut loss = 0.0;
    for batch in &validation.batches {
        let (found, mean_loss) = network.judge(batch)?;
        loss += mean_loss * found.len() as f64;
        poses.extend(found.into_iter().zip(batch.truths().iter().copied()));
    }
    let errors = PoseErrors::of(&poses);
    Ok(ValidationErrors {
        loss: loss / poses.len().max(1) as f64,
        mae_r_deg: errors.euler_mae_deg,
        mae_t: errors.translation_mae,
        recall: Recall::of(&poses, |_| Tolerance::object(DIAMETER)).share(),
    })
}

/// Errors of the parts' validations taken together; `None` where no part has a pair.
pub(super) fn validate_together(
    network: &Learned,
    validations: &[Validation],
    team: &mut dyn Team,
) -> Result<Option<ValidationErrors>> {
    let own = validations.iter().map(|validation| {
        let pairs: usize = validation.batches.iter().map(|batch| batch.truths().len()).sum();
        // The errors of no pairs are not told, and weigh nothing.
        let found = if pairs == 0 { ValidationErrors::default() } else { validate(network, validation)? };
        Ok(vec![pairs as f64, found.loss, found.mae_r_deg, found.mae_t, found.recall])
    });
    let own = own.collect::<Result<_>>()?;
    let (pairs, mean) = mean(team, own)?;
    let [loss, mae_r_deg, mae_t, recall] = mean[..] else { return Ok(None) };
    Ok((pairs > 0.0).then_some(ValidationErrors { loss, mae_r_deg, mae_t, recall }))
}

/// A part of a run's shapes.
#[derive(Debug, Clone)]
pub struct Part {
    /// Shapes to learn from.
    pub shapes: Arc<Shapes>,
    /// Shapes to measure errors on.
    pub held_out: Arc<Shapes>,
}

impl Trainer {
    /// A new run, whose files come to `folder`.
    ///
    /// # Errors
    /// Where the configuration cannot be run.
    pub fn new(config: TrainingConfig, folder: &Path, device: &Device) -> Result<Self> {
        config.check()?;
        let device = device.clone().autodiff();
        let network = config.network.init(config.seed, &device)?;
        let state = State { config, origin: 0, step: 0, seconds: 0.0, history: History::new() };
        Ok(Self { folder: folder.into(), network, optimizer: adam(), state })
    }

    /// A new run, or where one of this configuration in `folder` was stopped, that one.
    ///
    /// # Errors
    /// As [`Self::new`], or where a checkpoint is damaged.
    pub fn start(config: TrainingConfig, folder: &Path, device: &Device) -> Result<Self> {
        match Self::stopped(&config, folder, device)? {
            Some(stopped) => Ok(stopped),
            None => Self::new(config, folder, device),
        }
    }

    /// A run on weights that were learned before; goes on where one of this configuration and origin in `folder` was
    /// stopped. `origin` tells apart what is learned from, weights and shapes.
    ///
    /// # Errors
    /// Where the configuration cannot be run, or a checkpoint is damaged.
    pub fn adapting(config: TrainingConfig, network: &Learned, origin: u64, folder: &Path) -> Result<Self> {
        config.check()?;
        let stopped = Self::stopped(&config, folder, &network.device().inner())?;
        if let Some(stopped) = stopped.filter(|stopped| stopped.state.origin == origin) {
            return Ok(stopped);
        }
        let state = State { config, origin, step: 0, seconds: 0.0, history: History::new() };
        Ok(Self { folder: folder.into(), network: network.clone(), optimizer: adam(), state })
    }

    /// The run in `folder`, where there is one of this configuration.
    fn stopped(config: &TrainingConfig, folder: &Path, device: &Device) -> Result<Option<Self>> {
        if !folder.join(CHECKPOINT).exists() {
            return Ok(None);
        }
        Ok(Some(Self::resume(folder, device)?).filter(|stopped| stopped.state.config == *config))
    }

    /// Goes on where the run in `folder` was stopped.
    ///
    /// # Errors
    /// Where there is no checkpoint, or it is damaged.
    pub fn resume(folder: &Path, device: &Device) -> Result<Self> {
        let path = folder.join(CHECKPOINT);
        let (state, network, optimizer) = checkpoint::load(&path, adam(), &device.clone().autodiff())?;
        Ok(Self { folder: folder.into(), network, optimizer, state })
    }

    /// The network as it is now.
    pub fn network(&self) -> &Learned {
        &self.network
    }

    /// What the run was told.
    pub fn config(&self) -> &TrainingConfig {
        &self.state.config
    }

    /// Steps done.
    pub fn steps(&self) -> u64 {
        self.state.step
    }

    /// Seconds spent on them.
    pub fn seconds(&self) -> f64 {
        self.state.seconds
    }

    /// The learning curve so far.
    pub fn history(&self) -> &History {
        &self.state.history
    }

    /// The weights as a file.
    pub fn weights(&self) -> TensorFile {
        self.network.store()
    }

    /// Trains to the end, or until the watcher says stop; `true` at the end. `shapes` are split into those to learn
    /// from and those held out.
    ///
    /// # Errors
    /// Where a shape has too few points, a file cannot be written, or the loss is no longer finite.
    pub fn run(&mut self, shapes: &Shapes, mixture: &Mixture, watcher: &mut dyn Watcher) -> Result<bool> {
        let (learned, held_out) = shapes.split_every_nth(self.state.config.validation_every_nth);
        let parts = self.state.config.parts;
        let parts = learned.in_parts(parts).into_iter().zip(held_out.in_parts(parts));
        let parts: Vec<Part> = parts
            .map(|(shapes, held_out)| Part { shapes: Arc::new(shapes), held_out: Arc::new(held_out) })
            .collect();
        self.run_on(&parts, mixture, Poses::Fresh, &mut Alone, watcher)
    }

    /// The same with given shapes: those of the parts that are the team's member's own.
    ///
    /// # Errors
    /// As [`Self::run`], and where a member of the team is lost.
    pub fn run_on(
        &mut self,
        parts: &[Part],
        mixture: &Mixture,
        poses: Poses,
        team: &mut dyn Team,
        watcher: &mut dyn Watcher,
    ) -> Result<bool> {
        let config = self.state.config.clone();
        let shapes = team.gather(parts.iter().map(|part| vec![part.shapes.len() as f64]).collect())?;
        let shapes = shapes.iter().flatten().sum::<f64>() as usize;
        let lengths: Vec<u64> = config.stages.iter().map(|stage| stage.steps(shapes)).collect();
        let steps = lengths.iter().sum();
        let mut before = 0;
        for ((index, stage), length) in config.stages.iter().enumerate().zip(&lengths) {
            let end = before + length;
            if self.state.step < end {
                let later: u64 = config.stages[index + 1..]
                    .iter()
                    .zip(&lengths[index + 1..])
                    .map(|(stage, steps)| steps * 2 * stage.batch as u64)
                    .sum();
                let place = Place { index, stage, poses, first: before, end, steps, later };
                if !self.stage(parts, mixture, &place, team, watcher)? {
                    self.save()?;
                    return Ok(false);
                }
            }
            before = end;
        }
        self.save()?;
        Ok(true)
    }

    fn stage(
        &mut self,
        parts: &[Part],
        mixture: &Mixture,
        place: &Place,
        team: &mut dyn Team,
        watcher: &mut dyn Watcher,
    ) -> Result<bool> {
        let config = self.state.config.clone();
        let seen = place.stage.network(&config.network);
        let mut loaders = Vec::new();
        let mut validations = Vec::new();
        for (part, index) in parts.iter().zip(team.own(config.parts)) {
            let plan = Plan::Training(Training {
                mixture: mixture.clone(),
                points: place.stage.points,
                poses: place.poses,
                seed: config.seed_of(&format!("stage {}", place.index), index),
                // Counted from the stage's start: parts of a few shapes more have longer epochs.
                from: Position { epoch: 0, batch: self.state.step - place.first },
            });
            let seen_by = seen.clone();
            let prepare =
                move |example: &Example| seen_by.input(example.source.clone(), example.target.clone());
            let batch = share(place.stage.batch, index, config.parts).len();
            loaders.push(Loader::start(&part.shapes, &plan, batch, LOADER_THREADS, prepare)?);
            validations.push(Validation::new(&part.held_out, mixture, place.stage.points, &seen)?);
        }
        let mut since = Since::default();
        let mut saved = Instant::now();
        while self.state.step < place.end {
            let start = Instant::now();
            let batches = loaders.iter_mut().map_while(Iterator::next);
            let batches = batches.map(|batch| batch.map(|b| Batch::new(b.prepared, b.T_target_source)));
            let batches = batches.collect::<Result<Vec<_>>>()?;
            let rate = config.step_size(self.state.step, place.steps);
            let loss = self.step(&batches, rate, team)?;
            self.state.step += 1;
            since.loss += loss;
            since.steps += 1;
            since.seconds += start.elapsed().as_secs_f64();
            self.state.seconds += start.elapsed().as_secs_f64();

            let step = self.state.step;
            let validates = step.is_multiple_of(config.validation_steps.max(1)) || step == place.end;
            if validates || since.told.elapsed() >= EVENT_EVERY {
                let event = Event {
                    step,
                    steps: place.steps,
                    points: place.stage.points,
                    loss: since.loss / since.steps as f64,
                    validation: if validates {
                        validate_together(&self.network, &validations, team)?
                    } else {
                        None
                    },
                    learning_rate: rate,
                    clouds_per_second: (since.steps * 2 * place.stage.batch) as f64 / since.seconds,
                    seconds: self.state.seconds,
                };
                if validates {
                    self.state.history.push(event);
                }
                let left = (place.end - step) * 2 * place.stage.batch as u64 + place.later;
                watcher.event(&event, left);
                since = Since::default();
            }
            if watcher.stop() {
                return Ok(false);
            }
            if saved.elapsed().as_secs_f64() >= config.checkpoint_seconds {
                self.save()?;
                saved = Instant::now();
            }
        }
        Ok(true)
    }

    /// One step of Adam on a batch, of which the team's member has these parts; its mean loss.
    ///
    /// # Errors
    /// Where the loss is not finite, the batch was made for another network, or a member of the team is lost.
    pub fn step(&mut self, batches: &[Batch], rate: f64, team: &mut dyn Team) -> Result<f64> {
        let step = self.state.step;
        let mut rows = Vec::new();
        let mut lesson = None;
        for (batch, part) in batches.iter().zip(team.own(self.state.config.parts)) {
            let seed = self.state.config.seed_of(&format!("step {step}"), part);
            let (loss, statistics) = self.network.learn(batch, seed)?;
            let value = f64::from(loss.clone().into_scalar::<f32>());
            let gradients = GradientsParams::from_grads(loss.backward(), &self.network);
            let own = Lesson { loss: value, gradients, statistics };
            rows.push(own.to_row(batch.truths().len(), &self.network));
            lesson = Some(own);
        }
        let (_, mean) = mean(team, rows)?;
        let Some(lesson) = lesson.map(|own| own.filled(&mean, &self.network)).transpose()? else {
            return Err(Error::InvalidSetting { name: "team", reason: "a member has no part".into() });
        };
        if !lesson.loss.is_finite() {
            return Err(Error::Diverged { step });
        }
        let network = self.optimizer.step(rate, self.network.clone(), lesson.gradients);
        self.network = network.observed(&lesson.statistics, STATISTICS_SHARE);
        Ok(lesson.loss)
    }

    /// Writes the checkpoint.
    fn save(&self) -> Result<()> {
        checkpoint::save(&self.folder.join(CHECKPOINT), &self.state, &self.network, &self.optimizer)
    }
}

/// What has been summed since the last event.
struct Since {
    loss: f64,
    steps: usize,
    seconds: f64,
    told: Instant,
}

impl Default for Since {
    fn default() -> Self {
        Self { loss: 0.0, steps: 0, seconds: 0.0, told: Instant::now() }
    }
}

/// A stage's place in the run.
struct Place<'a> {
    index: usize,
    stage: &'a Stage,
    poses: Poses,
    /// Steps of the run before it and to its end, and of the whole run.
    first: u64,
    end: u64,
    steps: u64,
    /// Clouds of the stages after it.
    later: u64,
}

impl Stage {
    /// The network's configuration as its inputs see it.
    fn network(&self, config: &LearnedConfig) -> LearnedConfig {
        config.with_neighbors(self.k)
    }

    fn steps(&self, shapes: usize) -> u64 {
        match self.length {
            Length::Epochs(epochs) => epochs * (shapes / self.batch).max(1) as u64,
            Length::Steps(steps) => steps,
        }
    }
}

fn adam() -> ModuleOptimizer {
    AdamConfig::new().with_epsilon(1e-8).init()
}
