//! Training: the loop, what it keeps, and how it goes on after a stop.

mod adapt;
mod checkpoint;
mod config;
mod history;
mod plot;
mod trainer;

pub use adapt::{ADAPTATION_EPOCHS, ADAPTATION_RATE, Adaptation, adapt};
pub use config::{Decay, Length, Stage, TrainingConfig};
pub use history::{Event, History, Silent, ValidationErrors, Watcher};
pub use plot::{learning_curve, write_history};
pub use trainer::{Poses, Trainer, Validation, validate};
