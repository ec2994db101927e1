//! Is the pose right? Overlap on held-out points, the runner-up, conditioning, and a probability from them.

mod conditioning;
mod overlap;
mod verdict;

pub(crate) use conditioning::Uncertainty;
pub(crate) use overlap::{distances, overlap_at};
pub(crate) use verdict::{Evidence, judge};
