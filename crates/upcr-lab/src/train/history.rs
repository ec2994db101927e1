//! What a run tells while it goes, and keeps.

use std::time::Duration;

use serde::{Deserialize, Serialize};

/// Errors on pairs that no gradient came from, whose true poses are known.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ValidationErrors {
    /// Mean loss: of UPCR the Chamfer distance between canonical shapes.
    pub loss: f64,
    /// Mean absolute error of the Euler angles, in degrees.
    pub mae_r_deg: f64,
    /// Mean absolute error of the translations' components.
    pub mae_t: f64,
    /// Share of the pairs within 5° and a tenth of a unit-sphere shape's diameter.
    pub recall: f64,
}

/// A point of the learning curve.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Event {
    /// Steps done.
    pub step: u64,
    /// Steps of the whole run.
    pub steps: u64,
    /// Points of a cloud at this stage.
    pub points: usize,
    /// Mean loss since the last event.
    pub loss: f64,
    /// Errors on the held-out shapes, where they were measured.
    pub validation: Option<ValidationErrors>,
    /// Step size.
    pub learning_rate: f64,
    /// Clouds a second since the last event.
    pub clouds_per_second: f64,
    /// Seconds spent on training, over all parts of an interrupted run.
    pub seconds: f64,
}

impl Event {
    /// Time to the run's end at the pace so far of this stage.
    pub fn time_left(&self, clouds_left: u64) -> Duration {
        Duration::try_from_secs_f64(clouds_left as f64 / self.clouds_per_second).unwrap_or(Duration::MAX)
    }
}

/// The learning curve.
pub type History = Vec<Event>;

/// Someone who is told of a run's progress and may end it.
pub trait Watcher {
    /// Called at every event; `clouds_left` are the clouds of the run's remaining steps.
    fn event(&mut self, event: &Event, clouds_left: u64);

    /// Whether the run is to stop after this step; it can be resumed.
    fn stop(&mut self) -> bool {
        false
    }
}

/// A watcher who says nothing.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Watcher for Silent {
    fn event(&mut self, _: &Event, _: u64) {}
}
