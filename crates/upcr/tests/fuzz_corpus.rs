//! The fuzzer's seeds, and every input that ever broke something, as its targets read them.

#![allow(clippy::unwrap_used, clippy::panic)]

mod common;
#[path = "../../../fuzz/src/lib.rs"]
#[allow(dead_code, clippy::duplicate_mod)]
mod fuzz;
#[path = "common/seeds.rs"]
mod seeds;
#[path = "common/weights.rs"]
mod weights;

use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use arbitrary::{Arbitrary, Unstructured};
use fuzz::register::Task;
use upcr::io::{self, Intrinsics, ReadOptions};
use upcr::{net::Network, register};

const CAMERA: Intrinsics = Intrinsics { fx: 2.0, fy: 3.0, cx: 4.0, cy: 5.0 };

/// A folder of the fuzzer's.
fn folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz").join(name)
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

fn targets() -> Vec<String> {
    let name = |path: &PathBuf| path.file_stem().unwrap().to_str().unwrap().to_owned();
    files(&folder("fuzz_targets")).iter().map(name).collect()
}

#[test]
fn nothing_breaks_again() {
    let mut broken = Vec::new();
    for target in targets() {
        let seeds = files(&folder("corpus").join(&target));
        assert!(!seeds.is_empty(), "{target} has no corpus");
        for path in seeds.into_iter().chain(files(&folder("regressions").join(&target))) {
            let data = std::fs::read(&path).unwrap();
            if catch_unwind(AssertUnwindSafe(|| fuzz::run(&target, &data))).is_err() {
                broken.push(path);
            }
        }
    }
    assert!(broken.is_empty(), "{broken:#?}");
}

/// Every format has a target, so that a new one is not forgotten.
#[test]
fn every_format_is_fuzzed() {
    let fuzzed: Vec<_> = targets().iter().filter_map(|t| upcr::io::format_name(format!("a.{t}"))).collect();
    for (extension, _) in upcr::io::extensions() {
        let format = upcr::io::format_name(format!("a.{extension}")).unwrap();
        assert!(fuzzed.contains(&format), "{format}");
    }
}

/// Seeds that are refused at the first look would lead the fuzzer nowhere. `UPCR_WRITE_SEEDS=1` puts them into the corpus.
#[test]
fn seeds_are_what_they_are_called() {
    let options = ReadOptions { intrinsics: Some(CAMERA), mesh_samples: 9, ..ReadOptions::default() };
    for target in targets() {
        for (name, bytes) in seeds::seeds(&target) {
            let stream = Cursor::new(&bytes);
            let understood = match target.as_str() {
                "transform" => io::read_transform_from("pose", stream).map(drop),
                "weights" => Network::from_safetensors(&bytes).map(drop),
                "register" => {
                    let task = Task::arbitrary(&mut Unstructured::new(&bytes)).unwrap();
                    assert_eq!((task.source.len(), task.target.len()), (64, 64), "{name}");
                    register(&task.source, &task.target, &task.settings).map(drop)
                }
                extension => io::read_cloud_from(format!("a.{extension}"), stream, &options).map(|cloud| {
                    assert!(!cloud.is_empty(), "{target} {name}");
                }),
            };
            assert!(understood.is_ok(), "{target} {name}: {understood:?}");
            if std::env::var_os("UPCR_WRITE_SEEDS").is_some() {
                let folder = folder("corpus").join(&target);
                std::fs::create_dir_all(&folder).unwrap();
                std::fs::write(folder.join(format!("seed_{name}")), bytes).unwrap();
            }
        }
    }
}
