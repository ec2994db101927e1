//! A run that is killed goes on as if nothing had happened.
#![cfg(feature = "train")]
#![allow(missing_docs, clippy::unwrap_used, clippy::panic)]

use std::path::Path;
use std::sync::Arc;

use rand::Rng;
use upcr::net::NetworkConfig;
use upcr_lab::Device;
use upcr_lab::data::Shapes;
use upcr_lab::data::pairs::Protocol;
use upcr_lab::models::attention::TransformerConfig;
use upcr_lab::models::dcp::DcpConfig;
use upcr_lab::models::pointnetlk::PointNetLkConfig;
use upcr_lab::models::prnet::{PrnetConfig, Sampler};
use upcr_lab::models::tensor_file::TensorFile;
use upcr_lab::models::{Learned, LearnedConfig};
use upcr_lab::random;
use upcr_lab::train::{Event, Length, Poses, Stage, Trainer, TrainingConfig, Validation, Watcher, validate};

fn shapes() -> Shapes {
    let cloud = |seed| -> Vec<[f32; 3]> {
        let mut rng = random::stream(seed, 1);
        (0..100)
            .map(|_| std::array::from_fn(|axis| rng.random_range(-0.5..0.5) / (axis + 1) as f32))
            .collect()
    };
    Shapes { clouds: (0..12).map(cloud).collect(), labels: vec![0; 12], names: vec!["box".into()] }
}

fn upcr() -> LearnedConfig {
    let network = NetworkConfig { k: 6, widths: vec![8, 12, 16], head: vec![8], ..NetworkConfig::default() };
    LearnedConfig::Upcr(network)
}

/// Small ones of every other kind; PRNet draws while it learns.
fn others() -> [LearnedConfig; 3] {
    let attention = TransformerConfig { channels: 16, heads: 2, blocks: 1, inner: 16 };
    [
        LearnedConfig::PointNetLk(PointNetLkConfig { widths: [8, 8, 8, 16, 32], steps: 3 }),
        LearnedConfig::Dcp(DcpConfig { channels: 16, pointer: Some(attention), ..DcpConfig::default() }),
        LearnedConfig::Prnet(PrnetConfig { attention, passes: 2, ..PrnetConfig::default() }),
    ]
}

fn config(network: LearnedConfig) -> TrainingConfig {
    TrainingConfig {
        seed: 4,
        stages: vec![
            Stage { points: 32, k: Some(4), batch: 3, length: Length::Epochs(4) },
            Stage { points: 48, k: None, batch: 5, length: Length::Steps(7) },
        ],
        validation_every_nth: 6,
        validation_steps: 4,
        network,
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

fn learn(network: LearnedConfig, folder: &Path, stops: &[u32]) -> TensorFile {
    let mixture = vec![(Protocol::CONSISTENT, 1.0), (Protocol::PARTIAL_SHARED.noisy(), 1.0)];
    let mut trainer = Trainer::new(config(network), folder, &Device::flex()).unwrap();
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
    for network in others().into_iter().chain([upcr()]) {
        let [whole, parts] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let expected = learn(network.clone(), whole.path(), &[]);
        assert_eq!(learn(network, parts.path(), &[1, 4, 6, 3]), expected);
        assert!(expected.tensors.len() > 20);
    }
}

#[test]
fn every_network_learns_and_comes_back_from_its_file() {
    let set = Arc::new(shapes());
    let mixture = vec![(Protocol::CONSISTENT, 1.0)];
    for mut network in others().into_iter().chain([upcr()]) {
        if let LearnedConfig::Prnet(prnet) = &mut network {
            // What is drawn is too noisy for so few steps.
            prnet.sampler = Sampler::Softmax;
        }
        let folder = tempfile::tempdir().unwrap();
        let stages = vec![Stage { points: 48, k: None, batch: 6, length: Length::Steps(60) }];
        let config = TrainingConfig { stages, learning_rate: 5e-3, ..config(network.clone()) };
        let mut trainer = Trainer::new(config, folder.path(), &Device::flex()).unwrap();
        let pairs = Validation::new(&set, &mixture, 48, &network).unwrap();
        trainer.run_on(&set, &set, &mixture, Poses::Fixed, &mut After(u32::MAX)).unwrap();
        let history = trainer.history();
        let [first, last] = [history.first(), history.last()].map(|event| event.unwrap().loss);
        assert!(last < 0.8 * first, "{network:?}: {first} to {last}");
        let file =
            TensorFile::from_bytes(&trainer.weights().to_bytes().unwrap(), Path::new("weights")).unwrap();
        let again = Learned::restore(&file, Path::new("weights"), &Device::flex()).unwrap();
        assert_eq!(again.config(), network);
        let errors = [trainer.network(), &again].map(|network| validate(network, &pairs).unwrap());
        assert_eq!(errors[0], errors[1], "{network:?}");
    }
}

#[test]
fn a_damaged_checkpoint_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    assert!(Trainer::resume(folder.path(), &Device::flex()).is_err());
    learn(upcr(), folder.path(), &[]);
    let path = folder.path().join("checkpoint.safetensors");
    let bytes = std::fs::read(&path).unwrap();
    for length in [0, 7, 100, bytes.len() / 2, bytes.len() - 1] {
        std::fs::write(&path, &bytes[..length]).unwrap();
        assert!(Trainer::resume(folder.path(), &Device::flex()).is_err(), "{length}");
    }
}
