//! Inference of a network of the default size, with random weights, on points scattered over a bumpy torus.

#![allow(clippy::unwrap_used)]

use std::f32::consts::TAU;

use divan::Bencher;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use upcr::net::{Network, NetworkConfig};
use weights::{Precision, WeightsFile};

#[path = "../tests/common/weights.rs"]
mod weights;

fn main() {
    divan::main();
}

fn bumpy_torus(n: usize, seed: u64) -> Vec<[f32; 3]> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut point = || {
        let (u, v) = (rng.random_range(0.0..TAU), rng.random_range(0.0..TAU));
        let r = 0.3 + 0.05 * (5.0 * u).sin();
        [(0.7 + r * v.cos()) * u.cos(), (0.7 + r * v.cos()) * u.sin(), r * v.sin()]
    };
    (0..n).map(|_| point()).collect()
}

fn network() -> Network {
    let file = WeightsFile::random(&NetworkConfig::default(), 0).bytes(Precision::Single);
    Network::from_safetensors(&file).unwrap_or_else(|error| unreachable!("{error}"))
}

/// Two clouds of that many points on all threads.
#[divan::bench(args = [256, 1024, 2048])]
fn pair(bencher: Bencher, n: usize) {
    let (network, source, target) = (network(), bumpy_torus(n, 1), bumpy_torus(n, 2));
    bencher.bench(|| network.predict(&source, &target));
}

/// One cloud on one thread.
#[divan::bench(args = [1024])]
fn cloud_on_one_thread(bencher: Bencher, n: usize) {
    let (network, cloud) = (network(), bumpy_torus(n, 1));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    bencher.bench_local(|| pool.as_ref().map(|pool| pool.install(|| network.representations(&cloud))));
}
