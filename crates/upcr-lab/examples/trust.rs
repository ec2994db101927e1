//! Measures whether registrations say the truth about themselves.
//!
//! `trust covariance SHAPES [PAIRS] [train|test] [gicp|plane|point|none]` or `trust free-axes [PAIRS]`

#![allow(clippy::print_stdout)]

use upcr::{Refinement, Settings};
use upcr_lab::data::{self, Split};
use upcr_lab::trust::{covariance, free_axes};

const SEED: u64 = 1;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    match words[..] {
        ["covariance", shapes, ref rest @ ..] => {
            let pairs = rest.first().map_or(Ok(1000), |n| n.parse())?;
            let split = if rest.get(1) == Some(&"train") { Split::Train } else { Split::Test };
            let refine = match rest.get(2) {
                Some(&"plane") => Refinement::Plane,
                Some(&"point") => Refinement::Point,
                Some(&"none") => Refinement::None,
                _ => Refinement::Gicp,
            };
            let settings = Settings { refine, ..Settings::default() };
            for coverage in covariance::measure(&data::open(shapes, split)?, pairs, SEED, &settings)? {
                println!("{}", serde_json::to_string(&coverage)?);
            }
        }
        ["free-axes", ref rest @ ..] => {
            let pairs = rest.first().map_or(Ok(100), |n| n.parse())?;
            for named in free_axes::measure(pairs, SEED, &Settings::default())? {
                println!("{}", serde_json::to_string(&named)?);
            }
        }
        _ => return Err("covariance SHAPES [PAIRS] [train|test] [REFINEMENT], or free-axes [PAIRS]".into()),
    }
    Ok(())
}
