//! What a stated probability is worth: how often poses said to be right so probably are right.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use upcr::TRUSTWORTHY;

use super::cases::Kind;
use super::observe::Observed;

/// Bins of equal width over the probability.
pub const BINS: usize = 10;
/// Probability that a user takes for certainty.
pub const SURE: f64 = 0.9;

/// Poses said to be right with nearly the same probability.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Bin {
    /// How many.
    pub count: usize,
    /// What was said, on average.
    pub mean_probability: f64,
    /// Share of right ones.
    pub share_right: f64,
}

/// Right and wrong poses of some pairs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Counts {
    /// Pairs.
    pub pairs: usize,
    /// Poses within the tolerance.
    pub right: usize,
    /// Of those, how many were not called registered.
    pub right_refused: usize,
    /// Wrong poses that were called registered.
    pub wrong_trusted: usize,
    /// Wrong poses with a probability of [`SURE`] or more.
    pub wrong_sure: usize,
}

/// Reliability over one set of pairs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reliability {
    /// Of all pairs.
    pub counts: Counts,
    /// The same by kind of pair.
    pub by_kind: BTreeMap<Kind, Counts>,
    /// Mean distance of what was said from what was true, over [`BINS`] bins, by their counts (Naeini et al., 2015).
    pub expected_calibration_error: f64,
    /// Probability that a right pose has the higher probability than a wrong one; none where there are not both.
    pub area_under_roc: Option<f64>,
    /// Lowest probabilities first.
    pub bins: Vec<Bin>,
}

impl Counts {
    fn of<'a>(observed: impl Iterator<Item = &'a Observed>) -> Self {
        let mut counts = Self::default();
        for o in observed {
            counts.pairs += 1;
            counts.right += usize::from(o.right);
            counts.right_refused += usize::from(o.right && o.probability < TRUSTWORTHY);
            counts.wrong_trusted += usize::from(!o.right && o.probability >= TRUSTWORTHY);
            counts.wrong_sure += usize::from(!o.right && o.probability >= SURE);
        }
        counts
    }
}

impl Reliability {
    /// Over what was observed.
    pub fn of(observed: &[Observed]) -> Self {
        let mut bins = [(0, 0.0, 0.0); BINS];
        for o in observed {
            let bin = &mut bins[((o.probability * BINS as f64) as usize).min(BINS - 1)];
            *bin = (bin.0 + 1, bin.1 + o.probability, bin.2 + f64::from(o.right));
        }
        let mean = |sum: f64, count: usize| if count == 0 { 0.0 } else { sum / count as f64 };
        let bins = bins.map(|(count, said, right)| Bin {
            count,
            mean_probability: mean(said, count),
            share_right: mean(right, count),
        });
        let off = bins.iter().map(|b| b.count as f64 * (b.mean_probability - b.share_right).abs());
        let kinds = Kind::ALL.into_iter().filter_map(|kind| {
            let counts = Counts::of(observed.iter().filter(|o| o.kind == kind));
            (counts.pairs > 0).then_some((kind, counts))
        });
        Self {
            counts: Counts::of(observed.iter()),
            by_kind: kinds.collect(),
            expected_calibration_error: off.sum::<f64>() / observed.len().max(1) as f64,
            area_under_roc: area_under_roc(observed),
            bins: bins.to_vec(),
        }
    }
}

/// By ranks (Mann and Whitney, 1947); ties count half.
fn area_under_roc(observed: &[Observed]) -> Option<f64> {
    let mut ranked: Vec<(f64, bool)> = observed.iter().map(|o| (o.probability, o.right)).collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
    let right = ranked.iter().filter(|(_, right)| *right).count();
    let wrong = ranked.len() - right;
    let (mut won, mut wrong_below) = (0.0, 0);
    for tied in ranked.chunk_by(|a, b| a.0 == b.0) {
        let right_here = tied.iter().filter(|(_, right)| *right).count();
        let wrong_here = tied.len() - right_here;
        won += right_here as f64 * (wrong_below as f64 + 0.5 * wrong_here as f64);
        wrong_below += wrong_here;
    }
    (right > 0 && wrong > 0).then(|| won / (right as f64 * wrong as f64))
}

#[cfg(test)]
mod tests {
    use upcr::Evidence;

    use super::*;

    fn said(probability: f64, right: bool) -> Observed {
        let evidence = Evidence::none(100);
        Observed { kind: Kind::Noisy, right, probability, evidence, reasons: Vec::new() }
    }

    #[test]
    fn what_is_said_is_held_against_what_is_true() {
        // Eight of ten said to be right with 0.85 are, and none of ten said with 0.1.
        let mut observed: Vec<Observed> = (0..10).map(|i| said(0.85, i < 8)).collect();
        observed.extend((0..10).map(|_| said(0.1, false)));
        let found = Reliability::of(&observed);
        assert!((found.expected_calibration_error - (0.5 * 0.05 + 0.5 * 0.1)).abs() < 1e-12);
        // 8 right ones beat the 10 low ones and tie with the 2 high ones.
        assert!(
            (found.area_under_roc.unwrap() - (8.0 * 10.0 + 8.0 * 2.0 * 0.5) / (8.0 * 12.0)).abs() < 1e-12
        );
        let counts = Counts { pairs: 20, right: 8, right_refused: 0, wrong_trusted: 2, wrong_sure: 0 };
        assert_eq!(found.counts, counts);
        assert_eq!(found.by_kind[&Kind::Noisy], counts);
        assert_eq!(found.bins.iter().map(|b| b.count).sum::<usize>(), 20);
    }

    #[test]
    fn certainty_falls_into_the_last_bin() {
        let found = Reliability::of(&[said(1.0, true), said(0.0, false)]);
        assert_eq!((found.bins[BINS - 1].count, found.bins[0].count), (1, 1));
        assert_eq!((found.expected_calibration_error, found.area_under_roc), (0.0, Some(1.0)));
    }
}
