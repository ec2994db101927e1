//! Label-free adaptation: a learned network learns on from the clouds at hand (section III, fine-tuning).

use std::path::Path;
use std::sync::Arc;

use upcr::Result;

use super::config::{Decay, Length, Stage, TrainingConfig};
use super::history::{ValidationErrors, Watcher};
use super::plot::write_history;
use super::team::Team;
use super::trainer::{Part, Poses, Trainer, Validation, validate_together};
use crate::data::Shapes;
use crate::data::pairs::Mixture;
use crate::models::Learned;
use crate::random::fnv1a;

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

/// What is learned from.
#[derive(Debug, Clone)]
pub struct Material {
    /// Shapes of each part that is the team's member's own.
    pub parts: Vec<Arc<Shapes>>,
    /// Pairs that are made of them.
    pub mixture: Mixture,
    /// Whether a shape's pair changes from epoch to epoch.
    pub poses: Poses,
}

impl Material {
    /// A number that tells apart what runs start from: the network, all parts' shapes, and the pairs made of them.
    fn origin(&self, network: &Learned, team: &mut dyn Team) -> Result<u64> {
        let bytes = |cloud: &Vec<[f32; 3]>| -> Vec<u8> {
            cloud.as_flattened().iter().flat_map(|value| value.to_le_bytes()).collect()
        };
        let of_part = |shapes: &Arc<Shapes>| {
            let hashes: Vec<u64> = shapes.clouds.iter().map(|cloud| fnv1a(&bytes(cloud))).collect();
            let hash = fnv1a(&format!("{hashes:?}"));
            // Halves are exact as floating-point numbers.
            vec![(hash >> 32) as f64, f64::from(hash as u32)]
        };
        let parts = team.gather(self.parts.iter().map(of_part).collect())?;
        let weights = fnv1a(&network.store().to_bytes()?);
        Ok(fnv1a(&format!("{weights} {parts:?} {:?} {:?}", self.mixture, self.poses)))
    }
}

/// Learns on from all shapes without labels. The run's checkpoint comes to `folder`; a run that was stopped there goes on
/// where configuration, weights, shapes and pairs are the same.
///
/// # Errors
/// As [`Trainer::run_on`].
pub fn adapt(
    network: &Learned,
    material: &Material,
    config: TrainingConfig,
    folder: &Path,
    team: &mut dyn Team,
    watcher: &mut dyn Watcher,
) -> Result<Adaptation> {
    let Material { parts, mixture, poses } = material;
    let points = config.stages.last().map_or(crate::data::pairs::POINTS, |stage| stage.points);
    let validations = parts.iter().map(|shapes| Validation::new(shapes, mixture, points, &network.config()));
    let validations = validations.collect::<Result<Vec<_>>>()?;
    let validate = |network: &Learned, team: &mut dyn Team| {
        validate_together(network, &validations, team).map(Option::unwrap_or_default)
    };
    let before = validate(network, team)?;
    let origin = material.origin(network, team)?;
    let mut trainer = Trainer::adapting(config, network, origin, folder)?;
    let part = |shapes: &Arc<Shapes>| Part { shapes: shapes.clone(), held_out: shapes.clone() };
    let parts: Vec<Part> = parts.iter().map(part).collect();
    let finished = trainer.run_on(&parts, mixture, *poses, team, watcher)?;
    let after = validate(trainer.network(), team)?;
    let helped = after.loss < before.loss;
    let network = if helped { trainer.network() } else { network }.clone();
    write_history(folder, trainer.history())?;
    let (steps, seconds) = (trainer.steps(), trainer.seconds());
    Ok(Adaptation { network, helped, errors: [before, after], steps, seconds, finished })
}
