//! One training step of a network, the paper's where none is named: forward, loss, backward, Adam. Prints a JSON object; the arguments are
//! pairs, points and repeats, then, if wanted, neighbours and by what to divide the widths. `bench/train_step.py` holds
//! it against a plain PyTorch form. With another network's name before the numbers, that network in a quarter of its width
//! takes the steps.
#![allow(missing_docs, clippy::print_stdout, clippy::unwrap_used)]

use std::time::Instant;

use upcr::{Rigid, net::NetworkConfig};
use upcr_lab::Device;
use upcr_lab::models::learned::NETWORKS;
use upcr_lab::models::{Batch, LearnedConfig};
use upcr_lab::random;
use upcr_lab::train::{Alone, Trainer, TrainingConfig};

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() {
    let name = std::env::args().find(|arg| NETWORKS.contains(&arg.as_str()));
    let numbers: Vec<usize> = std::env::args().filter_map(|arg| arg.parse().ok()).collect();
    let [pairs, points, repeats, ref narrower @ ..] = *numbers else {
        println!("{{\"usage\": \"train_step [NETWORK] PAIRS POINTS REPEATS [K [DIVISOR]]\"}}");
        return;
    };
    let mut config = TrainingConfig::default();
    let mut network = NetworkConfig::default();
    network.k = narrower.first().copied().unwrap_or(network.k);
    let divisor = narrower.get(1).copied().unwrap_or(1);
    network.widths.iter_mut().chain(&mut network.head).for_each(|width| *width /= divisor);
    config.network = match name {
        Some(name) => {
            LearnedConfig::by_name(&name).unwrap().narrow().with_neighbors(narrower.first().copied())
        }
        None => LearnedConfig::Upcr(network),
    };
    let mut rng = random::stream(1, 0);
    let mut cloud = || -> Vec<[f32; 3]> {
        (0..points).map(|_| random::direction(&mut rng).map(|v| v as f32).into()).collect()
    };
    let inputs: Vec<_> = (0..pairs).map(|_| config.network.input(cloud(), cloud()).unwrap()).collect();
    let batch = Batch::new(inputs, vec![Rigid::identity(); pairs]);
    let folder = std::env::temp_dir();
    let mut trainer = Trainer::new(config, &folder, &Device::flex()).unwrap();
    let mut times_ms: Vec<f64> = (0..=repeats)
        .map(|_| {
            let start = Instant::now();
            trainer.step(std::slice::from_ref(&batch), 1e-3, &mut Alone).unwrap();
            start.elapsed().as_secs_f64() * 1e3
        })
        .skip(1)
        .collect();
    times_ms.sort_by(f64::total_cmp);
    println!(
        "{{\"pairs\": {pairs}, \"points\": {points}, \"ms_median\": {:.2}, \"ms_min\": {:.2}, \"clouds_per_second\": {:.1}, \"threads\": {}}}",
        times_ms[times_ms.len() / 2],
        times_ms[0],
        2e3 * pairs as f64 / times_ms[times_ms.len() / 2],
        rayon::current_num_threads()
    );
}
