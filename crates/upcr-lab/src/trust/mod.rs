//! Whether what a registration says about itself is true.

pub mod covariance;
pub mod free_axes;
