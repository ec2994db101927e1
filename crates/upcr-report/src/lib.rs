//! A registration, or a merge of many scans, as one HTML page: the clouds in 3-D, the verdict, poses to copy. The page is
//! one file, opens without a network, and has none: what it may run is the one script that it holds, told by its hash.
//!
//! The script is built from `web/` in the repository and kept in `assets/`, so that building this crate needs no Node.

mod display;
mod html;
mod merge_page;
mod notation;
mod page;

pub use display::{CLOUD_COLORS, MOST_POINTS};
pub use html::Contents;
pub use merge_page::MergePage;
pub use notation::{Notation, notations};
pub use page::Page;
