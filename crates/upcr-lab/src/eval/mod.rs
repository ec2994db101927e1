//! How estimated poses are judged.

pub mod metrics;
