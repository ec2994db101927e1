//! A run that is killed goes on as if nothing had happened.
#![cfg(feature = "train")]
#![allow(missing_docs, clippy::unwrap_used, clippy::panic)]

use std::path::Path;

use rand::Rng;
use upcr::net::NetworkConfig;
use upcr_lab::Device;
use upcr_lab::data::Shapes;
use upcr_lab::data::pairs::Protocol;
use upcr_lab::models::weights::TensorFile;
use upcr_lab::random;
use upcr_lab::train::{Event, Length, Stage, Trainer, TrainingConfig, Watcher};

fn shapes() -> Shapes {
    let cloud = |seed| -> Vec<[f32; 3]> {
        let mut rng = random::stream(seed, 1);
        (0..100)
            .map(|_| std::array::from_fn(|axis| rng.random_range(-0.5..0.5) / (axis + 1) as f32))
            .collect()
    };
    Shapes { clouds: (0..12).map(cloud).collect(), labels: vec![0; 12], names: vec!["box".into()] }
}

fn config() -> TrainingConfig {
    TrainingConfig {
        seed: 4,
        stages: vec![
            Stage { points: 32, k: Some(4), batch: 3, length: Length::Epochs(4) },
            Stage { points: 48, k: None, batch: 5, length: Length::Steps(7) },
        ],
        validation_every_nth: 6,
        validation_steps: 4,
        network: NetworkConfig { k: 6, widths: vec![8, 12, 16], head: vec![8], ..NetworkConfig::default() },
        ..TrainingConfig::default()
    }
}

/// Stops after so many steps.
struct After(u32);

impl Watcher for After {
    fn event(&mut self, _: &Event, _: u64) {}

    fn stop(&mut self) -> bool {
        self.0 -= 1;
        self.0 == 0
    }
}

fn learn(folder: &Path, stops: &[u32]) -> TensorFile {
    let mixture = vec![(Protocol::CONSISTENT, 1.0), (Protocol::PARTIAL_SHARED.noisy(), 1.0)];
    let mut trainer = Trainer::new(config(), folder, &Device::flex()).unwrap();
    for &stop in stops {
        assert!(!trainer.run(&shapes(), &mixture, &mut After(stop)).unwrap());
        trainer = Trainer::resume(folder, &Device::flex()).unwrap();
    }
    assert!(trainer.run(&shapes(), &mixture, &mut After(u32::MAX)).unwrap());
    assert!(!trainer.history().is_empty());
    trainer.weights()
}

#[test]
fn a_stopped_run_reaches_the_weights_of_an_undisturbed_one() {
    let [whole, parts] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let expected = learn(whole.path(), &[]);
    assert_eq!(learn(parts.path(), &[1, 4, 6, 3]), expected);
    assert!(expected.tensors.len() > 20);
}

#[test]
fn a_damaged_checkpoint_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    assert!(Trainer::resume(folder.path(), &Device::flex()).is_err());
    learn(folder.path(), &[]);
    let path = folder.path().join("checkpoint.safetensors");
    let bytes = std::fs::read(&path).unwrap();
    for length in [0, 7, 100, bytes.len() / 2, bytes.len() - 1] {
        std::fs::write(&path, &bytes[..length]).unwrap();
        assert!(Trainer::resume(folder.path(), &Device::flex()).is_err(), "{length}");
    }
}
