//! The one error type of the library.

use std::path::PathBuf;

/// Result with the library's [`enum@Error`].
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Which of the two clouds of a registration an error speaks of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CloudRole {
    /// The cloud that is moved.
    Source,
    /// The cloud that stays.
    Target,
    /// A cloud on its own (features, normals, sampling).
    Cloud,
}

impl std::fmt::Display for CloudRole {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Source => "source",
            Self::Target => "target",
            Self::Cloud => "cloud",
        })
    }
}

/// Everything that can go wrong, each with what a user needs to mend it.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The operating system refused to read or write a file.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// A file is not what its format demands: truncated, malformed, or claiming more than it holds.
    #[error("{}: not a valid {format} file: {reason}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Name of the format it was read as.
        format: &'static str,
        /// What is wrong, and where.
        reason: String,
    },
    /// The format is not known, or cannot hold or do what was asked.
    #[error("{}: {reason}", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// What is not supported.
        reason: String,
    },
    /// Fewer points than the task needs.
    #[error("{role} has too few points: {found}, where {needed} are needed")]
    TooFewPoints {
        /// Which cloud.
        role: CloudRole,
        /// How many there are.
        found: usize,
        /// How many the task needs.
        needed: usize,
    },
    /// Coordinates that are NaN or infinite.
    #[error("{role} has NaN or infinite coordinates in {count} of its points, the first at index {first}")]
    NonFinite {
        /// Which cloud.
        role: CloudRole,
        /// How many such points.
        count: usize,
        /// Index of the first.
        first: usize,
    },
    /// The points do not span a surface: all equal, or all on one line.
    #[error("{role} is degenerate: {reason}")]
    Degenerate {
        /// Which cloud.
        role: CloudRole,
        /// In which way.
        reason: &'static str,
    },
    /// The loss of a network that learns is no longer finite.
    #[error("the loss is no longer finite at step {step}; a smaller step size may help")]
    Diverged {
        /// Steps done before.
        step: u64,
    },
    /// A network's weights are not what its configuration demands.
    #[error("network weights: {reason}")]
    InvalidWeights {
        /// What is wrong, and with which tensor.
        reason: String,
    },
    /// The memory that a registration may take does not suffice for any part of its clouds that is worth registering.
    #[error("a registration of these clouds needs at least {needed} bytes, where {given} are allowed")]
    TooLittleMemory {
        /// Bytes that it may take.
        given: u64,
        /// Bytes from which on it runs.
        needed: u64,
    },
    /// A setting is out of its range, or two settings contradict each other.
    #[error("setting `{name}`: {reason}")]
    InvalidSetting {
        /// The setting's name.
        name: &'static str,
        /// What is wrong with it.
        reason: String,
    },
}
