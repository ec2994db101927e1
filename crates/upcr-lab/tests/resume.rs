//! A run that is killed goes on as if nothing had happened.
#![cfg(feature = "train")]
#![allow(missing_docs, clippy::unwrap_used, clippy::panic)]

use std::ops::Range;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};

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
use upcr_lab::train::{
    Alone, Event, Length, Part, Poses, Stage, Team, Trainer, TrainingConfig, Validation, Watcher, validate,
};

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
        let part = Part { shapes: set.clone(), held_out: set.clone() };
        trainer.run_on(&[part], &mixture, Poses::Fixed, &mut Alone, &mut After(u32::MAX)).unwrap();
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

/// One of two who share a batch's parts out and hand each other rows through channels.
struct Member {
    first: bool,
    out: Sender<Vec<Vec<f64>>>,
    others: Receiver<Vec<Vec<f64>>>,
}

impl Team for Member {
    fn own(&self, parts: usize) -> Range<usize> {
        if self.first { 0..parts / 2 } else { parts / 2..parts }
    }

    fn gather(&mut self, own: Vec<Vec<f64>>) -> upcr::Result<Vec<Vec<f64>>> {
        self.out.send(own.clone()).unwrap();
        let others = self.others.recv().unwrap();
        Ok(if self.first { [own, others] } else { [others, own] }.concat())
    }
}

/// The tensors that a network has learned from the shapes' own parts.
fn learned_in(parts: &[Shapes], config: &TrainingConfig, team: &mut dyn Team) -> TensorFile {
    let folder = tempfile::tempdir().unwrap();
    let mixture = vec![(Protocol::CONSISTENT, 1.0)];
    let part =
        |shapes: &Shapes| Part { shapes: Arc::new(shapes.clone()), held_out: Arc::new(shapes.clone()) };
    let parts: Vec<Part> = parts.iter().map(part).collect();
    let mut trainer = Trainer::new(config.clone(), folder.path(), &Device::flex()).unwrap();
    assert!(trainer.run_on(&parts, &mixture, Poses::Fresh, team, &mut After(u32::MAX)).unwrap());
    assert!(trainer.history().last().unwrap().validation.is_some());
    trainer.weights()
}

#[test]
fn a_team_learns_what_one_does_alone() {
    let config = TrainingConfig { parts: 3, ..config(upcr()) };
    let parts = shapes().in_parts(3);
    let alone = learned_in(&parts, &config, &mut Alone);
    let whole = learned_in(&[shapes()], &TrainingConfig { parts: 1, ..config.clone() }, &mut Alone);
    assert_ne!(alone, whole, "parts normalise themselves");
    let [(to_second, from_first), (to_first, from_second)] = [channel(), channel()];
    let together = std::thread::scope(|scope| {
        let mut second = Member { first: false, out: to_first, others: from_first };
        let (theirs, config) = (&parts[1..], &config);
        let other = scope.spawn(move || learned_in(theirs, config, &mut second));
        let mut first = Member { first: true, out: to_second, others: from_second };
        let own = learned_in(&parts[..1], config, &mut first);
        [own, other.join().unwrap()]
    });
    assert_eq!(together[0], alone);
    assert_eq!(together[1], alone);
}

#[test]
fn more_parts_than_pairs_are_refused() {
    let refused = TrainingConfig { parts: 1000, ..config(upcr()) }.check().unwrap_err();
    assert!(refused.to_string().contains("parts"), "{refused}");
    assert!(TrainingConfig { parts: 0, ..config(upcr()) }.check().is_err());
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
