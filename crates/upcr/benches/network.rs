//! Inference of a network of the default size, with random weights, on points scattered over a bumpy torus. With
//! `--json POINTS REPEATS` it prints what predicting one pair takes; `bench/inference.py` holds that against a plain
//! PyTorch form.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

use std::f32::consts::TAU;
use std::time::Instant;

use divan::Bencher;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use upcr::net::{Network, NetworkConfig};
use weights::{Precision, WeightsFile};

#[path = "../tests/common/weights.rs"]
mod weights;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let numbers = arguments.iter().skip_while(|a| *a != "--json").skip(1).map_while(|a| a.parse().ok());
    match *numbers.collect::<Vec<usize>>() {
        [points, repeats, ..] if repeats > 0 => print_json(points, repeats),
        _ => divan::main(),
    }
}

fn print_json(points: usize, repeats: usize) {
    let (network, source, target) = (network(), bumpy_torus(points, 1), bumpy_torus(points, 2));
    let time_ms = |_| {
        let start = Instant::now();
        divan::black_box(network.predict(&source, &target)).unwrap();
        start.elapsed().as_secs_f64() * 1e3
    };
    // The first runs find room.
    let mut times_ms: Vec<f64> = (0..repeats + 3).map(time_ms).skip(3).collect();
    times_ms.sort_by(f64::total_cmp);
    println!(
        "{{\"points\": {points}, \"ms_median\": {:.3}, \"ms_min\": {:.3}, \"threads\": {}}}",
        times_ms[times_ms.len() / 2],
        times_ms[0],
        rayon::current_num_threads()
    );
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
