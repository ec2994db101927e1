//! The pose that the user gave.

use super::{Hypothesis, HypothesisSource, Problem};
use crate::settings::Method;

pub(super) struct Prior;

impl HypothesisSource for Prior {
    fn method(&self) -> Method {
        Method::Prior
    }

    fn needs_matches(&self) -> bool {
        false
    }

    fn propose(&self, problem: &Problem) -> Vec<Hypothesis> {
        vec![Hypothesis { pose: problem.init, method: Method::Prior, support: 0 }]
    }
}
