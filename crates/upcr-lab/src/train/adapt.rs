//! Label-free adaptation: a learned network learns on from the clouds at hand (section III, fine-tuning).

use std::path::Path;
use std::sync::Arc;

use upcr::Result;

use super::config::{Decay, Length, Stage, TrainingConfig};
use super::history::{ValidationErrors, Watcher};
use super::plot::write_history;
use super::trainer::{Poses, Trainer, Validation, validate};
use crate::data::Shapes;
use crate::data::pairs::Mixture;
use crate::models::Learned;

/// What came of an adaptation.
#[derive(Debug)]
pub struct Adaptation {
    /// The better network: the adapted one, or the old one where its loss is not lower.
    pub network: Learned,
    /// Whether the network is the adapted one.
    pub helped: bool,
    /// On the clouds' own pairs before, and after.
    pub errors: [ValidationErrors; 2],
    /// Steps done.
    pub steps: u64,
    /// Seconds spent on them.
    pub seconds: f64,
    /// Whether the run came to its end; stopped early, what had been learned until then counts.
    pub finished: bool,
}

/// Passes over the clouds in the paper's fine-tuning.
pub const ADAPTATION_EPOCHS: u64 = 200;
/// Its step size at the start.
pub const ADAPTATION_RATE: f64 = 1e-4;

impl TrainingConfig {
    /// The paper's fine-tuning, on clouds of so many points; it has [`ADAPTATION_EPOCHS`].
    pub fn adaptation(network: &Learned, points: usize, epochs: u64) -> Self {
        Self {
            stages: vec![Stage { points, k: None, batch: 26, length: Length::Epochs(epochs) }],
            learning_rate: ADAPTATION_RATE,
            decay: Decay::Cosine,
            network: network.config(),
            ..Self::default()
        }
    }
}

/// Learns on from all of `shapes` without labels. The run's checkpoint comes to `folder`; a run of the same
/// configuration that was stopped there goes on.
///
/// # Errors
/// As [`Trainer::run`].
pub fn adapt(
    network: &Learned,
    shapes: &Arc<Shapes>,
    mixture: &Mixture,
    poses: Poses,
    config: TrainingConfig,
    folder: &Path,
    watcher: &mut dyn Watcher,
) -> Result<Adaptation> {
    let points = config.stages.last().map_or(crate::data::pairs::POINTS, |stage| stage.points);
    let validation = Validation::new(shapes, mixture, points, &network.config())?;
    let before = validate(network, &validation)?;
    let mut trainer = Trainer::adapting(config, network, folder)?;
    let finished = trainer.run_on(shapes, shapes, mixture, poses, watcher)?;
    let after = validate(trainer.network(), &validation)?;
    let helped = after.loss < before.loss;
    let network = if helped { trainer.network() } else { network }.clone();
    write_history(folder, trainer.history())?;
    let (steps, seconds) = (trainer.steps(), trainer.seconds());
    Ok(Adaptation { network, helped, errors: [before, after], steps, seconds, finished })
}
