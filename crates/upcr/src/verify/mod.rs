//! Is the pose right? Overlap on held-out points, the runner-up, conditioning, and a probability from them.

mod calibration;
mod conditioning;
mod evidence;
mod free_space;
mod overlap;
mod scale;
mod verdict;

pub use calibration::{Calibration, FEATURES, Weights};
pub(crate) use conditioning::Uncertainty;
pub use evidence::Evidence;
pub(crate) use evidence::{meeting, seen};
pub(crate) use free_space::{Seen, View, in_free_space};
pub(crate) use overlap::overlap_at;
pub(crate) use scale::Sizes;
pub(crate) use verdict::judge;
