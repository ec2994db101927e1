//! Kinds of pairs that learning and evaluation share.

use std::path::Path;

use anyhow::Result;
use clap::ValueEnum;
use serde::{Deserialize, Serialize};
#[cfg(feature = "train")]
use upcr_lab::data::pairs::Protocol;
use upcr_lab::data::{self, Half, Shapes, Split};

/// Pairs that are made of shapes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Pairs {
    /// Unseen point clouds: the training split
    Upc,
    /// Unseen categories: the first half of the categories
    Uc,
    /// Noisy data: the training split, noise on every point
    Nd,
    /// All kinds at once: clean and noisy, whole and partial
    Mixed,
}

impl Pairs {
    /// Those that adaptation learns from where nothing else is asked for.
    pub const ADAPTATION: Self = Self::Mixed;

    /// The protocols that these pairs follow, each with its share; `partial` keeps three quarters of each cloud.
    #[cfg(feature = "train")]
    pub fn mixture(self, partial: bool) -> Vec<(Protocol, f64)> {
        let whole = Protocol::CONSISTENT;
        let [shared, own] = [Protocol::PARTIAL_SHARED, Protocol::PARTIAL_INDEPENDENT];
        match (self, partial) {
            (Self::Upc | Self::Uc, false) => vec![(whole, 1.0)],
            (Self::Upc | Self::Uc, true) => vec![(shared, 1.0), (own, 1.0)],
            (Self::Nd, false) => vec![(whole.noisy(), 1.0)],
            (Self::Nd, true) => vec![(shared.noisy(), 1.0), (own.noisy(), 1.0)],
            (Self::Mixed, _) => vec![
                (whole, 4.0),
                (whole.noisy(), 2.0),
                (shared, 1.0),
                (own, 1.0),
                (shared.noisy(), 1.0),
                (own.noisy(), 1.0),
            ],
        }
    }

    pub(crate) fn shapes(self, path: &Path, split: Split) -> Result<Shapes> {
        let shapes = match (self, split) {
            (Self::Uc, Split::Train) => data::open(path, Split::All)?.categories(Half::First),
            (Self::Uc, _) => data::open(path, Split::All)?.categories(Half::Second),
            _ => data::open(path, split)?,
        };
        Ok(shapes)
    }
}
