//! Whether the verdicts can be trusted: fitting the probability, and measuring what it, the covariance and the free
//! directions are worth.

pub mod cases;
pub mod covariance;
mod fit;
pub mod free_axes;
mod observe;
#[cfg(feature = "train")]
mod plot;
mod reliability;
#[cfg(feature = "train")]
mod report;

pub use fit::fit;
pub use observe::{Observed, asked_in_all_ways, observe};
#[cfg(feature = "train")]
pub use plot::picture;
pub use reliability::{BINS, Bin, Counts, Reliability, SURE};
#[cfg(feature = "train")]
pub use report::{Trust, markdown};
