//! Training: the loop, what it keeps, and how it goes on after a stop.

mod adapt;
mod checkpoint;
mod config;
mod history;
mod plot;
mod team;
mod trainer;

pub use adapt::{ADAPTATION_EPOCHS, ADAPTATION_RATE, Adaptation, Material, adapt};
pub use config::{Decay, Length, Stage, TrainingConfig};
pub use history::{Event, History, Silent, ValidationErrors, Watcher};
pub use plot::{learning_curve, write_history};
pub use team::{Alone, Team};
pub use trainer::{Part, Poses, Trainer, Validation, validate};
