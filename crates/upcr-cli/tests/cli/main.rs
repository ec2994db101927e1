//! The binary as its users meet it: arguments in, stdout, stderr, files and an exit status out.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod bad_input;
#[cfg(feature = "train")]
mod calibrate;
mod commands;
#[cfg(feature = "train")]
mod learning;
mod merge;
mod register;
mod rerun;

use std::ffi::OsStr;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

/// A run of `upcr` that has ended.
struct Run {
    status: i32,
    stdout: String,
    stderr: String,
}

impl Run {
    fn json(&self) -> serde_json::Value {
        serde_json::from_str(&self.stdout)
            .unwrap_or_else(|e| panic!("{e}\nstdout: {}\n{}", self.stdout, self.stderr))
    }

    /// Ended with `status`, said nothing on stdout, and on stderr an error with all of `words`.
    #[track_caller]
    fn assert_fails(&self, status: i32, words: &[&str]) {
        assert_eq!(self.status, status, "{}", self.stderr);
        assert_eq!(self.stdout, "");
        assert!(self.stderr.starts_with("error: "), "{}", self.stderr);
        for word in words {
            assert!(self.stderr.contains(word), "`{word}` is missing in: {}", self.stderr);
        }
    }
}

fn command() -> Command {
    Command::new(env!("CARGO_BIN_EXE_upcr"))
}

fn upcr<A: AsRef<OsStr>>(args: impl IntoIterator<Item = A>) -> Run {
    let Output { status, stdout, stderr } =
        command().args(args).stdin(Stdio::null()).output().expect("the binary runs");
    Run {
        status: status.code().expect("no signal ended it"),
        stdout: String::from_utf8(stdout).expect("stdout is UTF-8"),
        stderr: String::from_utf8(stderr).expect("stderr is UTF-8"),
    }
}

/// A file of the committed sample pair.
fn sample(name: &str) -> String {
    let path: PathBuf = [env!("CARGO_MANIFEST_DIR"), "..", "..", "samples", name].iter().collect();
    path.to_str().expect("the path is UTF-8").to_owned()
}

/// A folder for one test and the files it makes.
struct Scratch(tempfile::TempDir);

impl Scratch {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a temporary folder"))
    }

    fn path(&self, name: &str) -> String {
        self.0.path().join(name).to_str().expect("the path is UTF-8").to_owned()
    }

    fn file(&self, name: &str, content: impl AsRef<[u8]>) -> String {
        let path = self.path(name);
        std::fs::write(&path, content).expect("the file is written");
        path
    }

    /// A cloud as text, one point a line.
    fn xyz(&self, name: &str, points: &[[f64; 3]]) -> String {
        let mut text = String::new();
        for [x, y, z] in points {
            writeln!(text, "{x} {y} {z}").unwrap();
        }
        self.file(name, text)
    }

    fn names(&self) -> Vec<String> {
        let mut names: Vec<_> = std::fs::read_dir(self.0.path())
            .unwrap()
            .map(|entry| entry.unwrap().file_name().to_str().unwrap().to_owned())
            .collect();
        names.sort();
        names
    }
}

/// The numbers of a text file.
fn numbers(path: impl AsRef<Path>) -> Vec<f64> {
    let text = std::fs::read_to_string(path).unwrap();
    text.split_whitespace().map(|word| word.parse().unwrap()).collect()
}

/// Rotation error in degrees and translation error of the row-major 4x4 `found` against `truth`.
fn pose_error(found: &[f64], truth: &[f64]) -> (f64, f64) {
    let trace: f64 = (0..3).flat_map(|r| (0..3).map(move |c| 4 * r + c)).map(|i| found[i] * truth[i]).sum();
    let offset: f64 = [3, 7, 11].iter().map(|&i| (found[i] - truth[i]).powi(2)).sum();
    (((trace - 1.0) / 2.0).clamp(-1.0, 1.0).acos().to_degrees(), offset.sqrt())
}

/// A curved surface, without symmetry, of `n * n` points over `size` by `size`.
fn surface(n: usize, size: f64) -> Vec<[f64; 3]> {
    let at = |i: usize| i as f64 / (n - 1) as f64;
    let height = |u: f64, v: f64| 0.2 * (5.0 * u).sin() + 0.15 * (7.0 * v + 2.0 * u).cos() + 0.3 * u * v;
    (0..n * n)
        .map(|i| (at(i / n), at(i % n)))
        .map(|(u, v)| [size * u, size * v, size * height(u, v)])
        .collect()
}
