//! Weights files made up for tests and benchmarks.

// Each user needs a part of it.
#![allow(dead_code)]

use std::collections::BTreeMap;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::json;
use upcr::net::{Invariant, NetworkConfig};

/// A weights file in memory.
#[derive(Debug, Clone)]
pub struct WeightsFile {
    pub metadata: BTreeMap<String, String>,
    /// Shape and values by name.
    pub tensors: BTreeMap<String, (Vec<usize>, Vec<f32>)>,
}

/// How a tensor's numbers are written.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Precision {
    Single,
    /// Rounded towards zero.
    BrainFloat,
}

impl WeightsFile {
    /// Random weights of the size that keeps features in their range; a third of batch norm's scales is negative.
    pub fn random(config: &NetworkConfig, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut file = Self { metadata: BTreeMap::new(), tensors: BTreeMap::new() };
        file.metadata.insert("upcr.config".into(), serde_json::to_string(config).unwrap());
        file.metadata.insert("upcr.trained".into(), "false".into());
        let mut edge_map = |file: &mut Self, name: String, inputs: usize, outputs: usize, input_sq: f32| {
            let reach = (3.0 / (inputs as f32 * input_sq)).sqrt();
            file.add(&format!("{name}.weight"), &[inputs, outputs], || rng.random_range(-reach..reach));
            let channels = [outputs];
            file.add(&format!("{name}.gamma"), &channels, || {
                rng.random_range(0.5..1.5) * if rng.random_bool(0.33) { -1.0 } else { 1.0 }
            });
            file.add(&format!("{name}.beta"), &channels, || rng.random_range(-0.3..0.3));
            file.add(&format!("{name}.mean"), &channels, || rng.random_range(-0.3..0.3));
            file.add(&format!("{name}.var"), &channels, || rng.random_range(0.5..1.5));
        };
        let mut branches = vec![("global", 3)];
        if config.invariant != Invariant::None {
            let inputs = config.invariant.edge_dim() + config.invariant.point_dim();
            let histogram = config.invariant.point_dim() > 0;
            let input_sq = if histogram { 100.0 } else { 0.3 };
            edge_map(&mut file, "invariant.embed".into(), inputs, config.widths[0], input_sq);
            branches.push(("invariant", config.widths[0]));
        }
        for (branch, inputs) in branches {
            let inputs = std::iter::once(inputs).chain(config.widths.iter().copied());
            for (l, (inputs, &outputs)) in inputs.zip(&config.widths).enumerate() {
                edge_map(&mut file, format!("{branch}.{l}"), 2 * inputs, outputs, 0.6);
            }
        }
        let mut inputs = config.representation();
        for (i, outputs) in config.head.iter().copied().chain([config.rotation.values() + 3]).enumerate() {
            let reach = (1.0 / inputs as f32).sqrt();
            file.add(&format!("head.{i}.weight"), &[inputs, outputs], || rng.random_range(-reach..reach));
            file.add(&format!("head.{i}.bias"), &[outputs], || rng.random_range(-0.3..0.3));
            inputs = outputs;
        }
        file
    }

    fn add(&mut self, name: &str, shape: &[usize], mut value: impl FnMut() -> f32) {
        let values = (0..shape.iter().product()).map(|_| value()).collect();
        self.tensors.insert(name.into(), (shape.to_vec(), values));
    }

    /// The file's bytes.
    pub fn bytes(&self, precision: Precision) -> Vec<u8> {
        let (mut header, mut data) = (serde_json::Map::new(), Vec::new());
        header.insert("__metadata__".into(), json!(self.metadata));
        for (name, (shape, values)) in &self.tensors {
            let start = data.len();
            for value in values {
                match precision {
                    Precision::Single => data.extend(value.to_le_bytes()),
                    Precision::BrainFloat => data.extend(&value.to_le_bytes()[2..]),
                }
            }
            let dtype = if precision == Precision::Single { "F32" } else { "BF16" };
            let entry = json!({ "dtype": dtype, "shape": shape, "data_offsets": [start, data.len()] });
            header.insert(name.clone(), entry);
        }
        let header = serde_json::to_string(&header).unwrap();
        [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &data].concat()
    }
}
