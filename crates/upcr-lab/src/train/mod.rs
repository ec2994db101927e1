//! Training without labels: the loop, what it keeps, and how it goes on after a stop.

mod checkpoint;
mod config;
mod history;
mod trainer;

pub use checkpoint::write_atomically;
pub use config::{Decay, Mixture, Stage, TrainingConfig};
pub use history::{Event, History, Silent, Watcher};
pub use trainer::{Trainer, Validation, validate};
