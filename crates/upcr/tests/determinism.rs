//! The same answer, to the last bit, on any number of threads and in every run.

#![allow(clippy::unwrap_used)]

mod common;

use std::num::NonZeroUsize;

use common::Pair;
use common::consistent::choices::METHODS;
use upcr::{Method, Settings, register};

/// The answer as JSON, without what may differ: the times and the number of threads asked for.
fn answer(pair: &Pair, method: Method, threads: usize) -> String {
    let init = (method == Method::Prior).then_some(pair.truth);
    let settings = Settings { method, init, threads: NonZeroUsize::new(threads), ..Settings::default() };
    let found = register(&pair.source, &pair.target, &settings).unwrap();
    let mut json = serde_json::to_value(&found).unwrap();
    json.as_object_mut().unwrap().remove("timings_ms").unwrap();
    json["settings"].as_object_mut().unwrap().remove("threads").unwrap();
    json.to_string()
}

#[test]
fn threads_and_runs_do_not_matter() {
    let pair = Pair::sample(2);
    for method in METHODS {
        let first = answer(&pair, method, 1);
        for threads in [1, 2, 3, 2] {
            assert_eq!(answer(&pair, method, threads), first, "{method:?} on {threads} threads");
        }
    }
}

/// Clouds that have nothing to do with each other go through every step to its end.
#[test]
fn failures_are_the_same_too() {
    let mut pair = Pair::sample(2);
    pair.target = common::sheet(60, 0.2, common::bumps);
    for method in [Method::Auto, Method::Prior] {
        let first = answer(&pair, method, 1);
        for threads in [2, 3] {
            assert_eq!(answer(&pair, method, threads), first, "{method:?} on {threads} threads");
        }
    }
}
