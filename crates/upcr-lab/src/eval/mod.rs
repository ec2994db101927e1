//! Evaluation of registrations: methods over protocols, and what their errors are.

pub mod methods;
pub mod metrics;
pub mod run;
