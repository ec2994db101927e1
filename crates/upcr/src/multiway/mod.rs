//! Many scans: which of them to register with each other, and poses of all from poses of pairs.

mod block_cholesky;
mod fuse;
mod merge;
mod pose_graph;
mod vocabulary;

pub use fuse::fuse;
pub use merge::{
    Attempt, JudgedAttempt, MergeProgress, MergeSettings, MergeStep, MergeWatch, Merged, Place, Proposal,
    Scans, merge,
};
pub use pose_graph::{Edge, Joining, Judged, PoseGraph, Solution};
pub use vocabulary::{Vocabulary, alike, looks};
