//! `upcr register`: two clouds in, a pose and a verdict out.

use std::fmt::Write;
use std::fs::File;
use std::io::{BufRead, BufReader, stdin};
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{Context, Result, bail};
use clap::{ArgGroup, ValueEnum};
use serde::Serialize;
use serde_json::Value;
use upcr::features::MatchedFeature;
use upcr::net::Network;
use upcr::{
    Calibration, Locks, Method, PointCloud, PoseStep, Refinement, Registration, Rigid, RobustKernel,
    Settings, Watch, io,
};
use upcr_lab::files::write_atomically;
use upcr_report::Page;

use crate::output::{self, Progress};
use crate::stream::{Layout, Shown, Streaming};
use crate::{Status, describe, input};

/// Find the pose that lays SOURCE on TARGET
#[derive(clap::Args)]
#[command(group = ArgGroup::new("structured").args(["json", "pairs"]).multiple(true))]
pub struct Args {
    /// The cloud that is moved
    #[arg(required_unless_present = "pairs")]
    source: Option<PathBuf>,
    /// The cloud that stays
    #[arg(required_unless_present = "pairs")]
    target: Option<PathBuf>,
    /// Register many pairs: a file (`-`: stdin) with SOURCE, TARGET and, if any, the first guess's file on each
    /// line, separated by tabs or blanks. Prints one JSON object a line, in the same order, as soon as it is known
    #[arg(long, value_name = "FILE", conflicts_with_all = ["source", "target", "init", "output", "transform", "report", "rerun"])]
    pairs: Option<PathBuf>,
    /// Where the first pose comes from
    #[arg(long, value_enum, default_value_t = Settings::default().method)]
    method: Method,
    /// Weights of the network [default: those in the program]
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// The feature that is matched, where the method matches one
    #[arg(long, value_enum, default_value_t = Settings::default().feature)]
    feature: MatchedFeature,
    /// What the refinement minimises
    #[arg(long, value_enum, default_value_t = Settings::default().refine)]
    refine: Refinement,
    /// The one scale that drives every radius, in the clouds' unit [default: derived from the clouds]
    #[arg(long, value_name = "LENGTH", allow_negative_numbers = true)]
    voxel_size: Option<f64>,
    /// A first guess of the pose: a text file with a 4x4 row-major matrix, source to target
    #[arg(long, value_name = "FILE")]
    init: Option<PathBuf>,
    /// How residuals of the refinement are weighed
    #[arg(long, value_enum, default_value_t = Settings::default().kernel)]
    kernel: RobustKernel,
    /// Share of the closest pairs that the refinement keeps, 0 to 1 [default: all within reach]
    #[arg(long, value_name = "SHARE", allow_negative_numbers = true)]
    overlap: Option<f64>,
    /// Degrees of freedom that keep their value in the first guess, e.g. `roll,pitch,z`
    #[arg(long, value_name = "AXES", value_enum, value_delimiter = ',')]
    lock: Vec<Axis>,
    /// What the evidence for a pose weighs: a file that `upcr calibrate` wrote [default: the calibration in the program]
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// Seed of every random choice
    #[arg(long, default_value_t = Settings::default().seed)]
    seed: u64,
    /// Threads to use; the result does not depend on it [default: all]
    #[arg(long)]
    threads: Option<NonZeroUsize>,
    /// Seconds after which a registration ends with the best pose so far; reading files is not counted [default: no limit]
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true)]
    max_seconds: Option<f64>,
    /// Memory that a registration may take, e.g. `512M` or `2G` (K, M, G and T are powers of 1024). Where a cloud needs more,
    /// every second, fourth, ... point of it is used. The clouds themselves, as the files' readers hold them, and the
    /// weights of `--weights` are not counted [default: no limit]
    #[arg(long, value_name = "BYTES", value_parser = input::bytes)]
    max_memory: Option<u64>,
    /// Write the source, moved onto the target
    #[arg(short, long, value_name = "CLOUD")]
    output: Option<PathBuf>,
    /// Write the pose as a text file with a 4x4 row-major matrix
    #[arg(long, value_name = "FILE")]
    transform: Option<PathBuf>,
    /// Write a report: one HTML page, which needs no network, with both clouds in 3-D before and after, the verdict, the
    /// alternatives, and the pose to copy
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    #[command(flatten)]
    stream: Streaming,
    /// Print one JSON object instead of a summary
    #[arg(long)]
    json: bool,
    /// Leave the times and the number of threads out of the JSON: equal answers are then equal bytes, however many threads
    /// found them (where no time limit ends the search)
    #[arg(long, requires = "structured")]
    no_times: bool,
    #[command(flatten)]
    reading: input::Reading,
}

/// A degree of freedom of the pose; angles are extrinsic, about x, y and z.
#[derive(Clone, Copy, ValueEnum)]
enum Axis {
    Roll,
    Pitch,
    Yaw,
    X,
    Y,
    Z,
}

impl Args {
    fn settings(&self) -> Result<Settings> {
        let mut locks = Locks::default();
        for axis in &self.lock {
            *match axis {
                Axis::Roll => &mut locks.roll,
                Axis::Pitch => &mut locks.pitch,
                Axis::Yaw => &mut locks.yaw,
                Axis::X => &mut locks.x,
                Axis::Y => &mut locks.y,
                Axis::Z => &mut locks.z,
            } = true;
        }
        Ok(Settings {
            method: self.method,
            network: self.weights.as_deref().map(Network::load).transpose()?.map(Arc::new),
            feature: self.feature,
            refine: self.refine,
            voxel_size: self.voxel_size,
            init: self.init.as_deref().map(io::read_transform).transpose()?,
            kernel: self.kernel,
            overlap: self.overlap,
            locks,
            calibration: self.calibration.as_deref().map(Calibration::load).transpose()?.map(Arc::new),
            seed: self.seed,
            threads: self.threads,
            max_seconds: self.max_seconds,
            max_memory_bytes: self.max_memory,
        })
    }

    /// What is told of an answer.
    fn told<'a, T: Serialize>(&self, answer: &'a T) -> Result<Told<'a, T>> {
        if !self.no_times {
            return Ok(Told::All(answer));
        }
        let mut value = serde_json::to_value(answer)?;
        if let Some(fields) = value.as_object_mut() {
            fields.remove("timings_ms");
            if let Some(settings) = fields.get_mut("settings").and_then(Value::as_object_mut) {
                settings.remove("threads");
            }
        }
        Ok(Told::WithoutTimes(value))
    }
}

pub fn run(args: &Args) -> Result<Status> {
    output::on_threads(args.threads, || match (&args.pairs, &args.source, &args.target) {
        (Some(list), ..) => run_pairs(args, list),
        (None, Some(source), Some(target)) => run_one(args, source, target),
        _ => bail!("a source and a target are needed"),
    })?
}

fn run_one(args: &Args, source_path: &Path, target_path: &Path) -> Result<Status> {
    let settings = args.settings()?;
    for path in [&args.transform, &args.output, &args.report].into_iter().flatten() {
        output::check_folder(path)?;
    }
    if let Some(path) = &args.output {
        io::check_writable(path)?;
    }
    let name = format!("{} -> {}", source_path.display(), target_path.display());
    let layout = Layout { clouds: true, curves: &["rmse", "paired"], words: true };
    let stream = args.stream.open(&name, &layout)?;
    let mut progress = Progress::new();
    progress.step("reading");
    let source = args.reading.read(source_path)?;
    let target = args.reading.read(target_path)?;
    let shown = stream.map(|stream| Shown::new(stream, &source, &target, &settings));
    let found = register(&source, &target, &settings, &mut progress, shown.as_ref())
        .map_err(|error| input::name_file(error, source_path, target_path))?;
    progress.step("writing");
    if let Some(path) = &args.transform {
        io::write_transform(path, &found.T_target_source)?;
    }
    if let Some(path) = &args.output {
        io::write_cloud(path, &source.transformed(&found.T_target_source))?;
    }
    if let Some(path) = &args.report {
        let names = input::short_names(&[source_path, target_path]);
        let comments = [io::read_comments(source_path)?, io::read_comments(target_path)?];
        let page = Page::of_registration((&names[0], &source), (&names[1], &target), &found)
            .with_comments(&comments);
        write_atomically(path, page.html()?.as_bytes())?;
    }
    let summary = summary(&found, args, source_path, target_path);
    if let Some(shown) = shown {
        shown.end(&found, &summary)?;
    }
    drop(progress);

    let trusted = found.is_trustworthy();
    for path in [&args.transform, &args.output].into_iter().flatten().filter(|_| !trusted) {
        output::note(&format!("warning: {}: written with a pose that is not trustworthy", path.display()));
    }
    if args.json {
        output::answer_json(&args.told(&found)?)?;
    } else {
        output::answer(&summary)?;
    }
    Ok(if trusted { Status::Done } else { Status::NotRegistered })
}

/// An answer as JSON.
#[derive(Serialize)]
#[serde(untagged)]
enum Told<'a, T> {
    All(&'a T),
    WithoutTimes(Value),
}

/// One line of the answer to a list of pairs.
#[derive(Serialize)]
struct PairAnswer<'a> {
    source: &'a str,
    target: &'a str,
    #[serde(flatten)]
    found: Option<Registration>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

/// Registers the pairs of a list one after the other; an error is told in its pair's place and ends nothing.
fn run_pairs(args: &Args, list: &Path) -> Result<Status> {
    let settings = args.settings()?;
    let lines: Box<dyn BufRead> = if list.as_os_str() == "-" {
        Box::new(stdin().lock())
    } else {
        Box::new(BufReader::new(File::open(list).with_context(|| list.display().to_string())?))
    };
    let (mut failed, mut untrusted) = (false, false);
    for line in lines.lines() {
        let line = line.with_context(|| list.display().to_string())?;
        let columns: Vec<&str> = if line.contains('\t') {
            line.split('\t').map(str::trim).collect()
        } else {
            line.split_whitespace().collect()
        };
        let (source, target, init) = match columns[..] {
            [] => continue,
            [comment, ..] if comment.starts_with('#') => continue,
            [source, target] => (source, target, None),
            [source, target, init] => (source, target, Some(init)),
            _ => bail!("{}: not two or three columns: {line:?}", list.display()),
        };
        let answer = register_pair(args, &settings, source.as_ref(), target.as_ref(), init.map(Path::new));
        failed |= answer.is_err();
        untrusted |= answer.as_ref().is_ok_and(|found| !found.is_trustworthy());
        let (found, error) = match answer {
            Ok(found) => (Some(found), None),
            Err(error) => (None, Some(describe(&error))),
        };
        output::answer_json_line(&args.told(&PairAnswer { source, target, found, error })?)?;
    }
    Ok(match (failed, untrusted) {
        (true, _) => Status::Failed,
        (false, true) => Status::NotRegistered,
        (false, false) => Status::Done,
    })
}

/// Registers two clouds, each step shown.
fn register(
    source: &PointCloud,
    target: &PointCloud,
    settings: &Settings,
    progress: &mut Progress,
    shown: Option<&Shown>,
) -> upcr::Result<Registration> {
    let progress = Mutex::new(progress);
    let show = |at: upcr::Progress| {
        let method = at.method.and_then(|m| m.to_possible_value());
        let method = method.map_or_else(String::new, |m| format!(" ({})", m.get_name()));
        let mut progress = progress.lock().unwrap_or_else(PoisonError::into_inner);
        let stage = format!("{}{method}", at.stage);
        progress.step(&format!("{stage}, {:.0} %", 100.0 * at.done));
        if let Some(shown) = shown {
            shown.stage(stage);
        }
    };
    let hear = |step: PoseStep| {
        if let Some(shown) = shown {
            shown.step(&step);
        }
    };
    let poses = shown.is_some().then_some(&hear as &(dyn Fn(PoseStep) + Sync));
    upcr::register_watched(
        source,
        target,
        settings,
        &Watch { progress: Some(&show), poses, ..Watch::default() },
    )
}

fn register_pair(
    args: &Args,
    settings: &Settings,
    source: &Path,
    target: &Path,
    init: Option<&Path>,
) -> Result<Registration> {
    let settings = Settings { init: init.map(io::read_transform).transpose()?, ..settings.clone() };
    let (a, b) = (args.reading.read(source)?, args.reading.read(target)?);
    upcr::register(&a, &b, &settings).map_err(|error| input::name_file(error, source, target))
}

/// Angle and axis.
fn rotation(pose: &Rigid) -> String {
    let rotation = pose.log().fixed_rows::<3>(0).into_owned();
    let angle = rotation.norm();
    let mut text = format!("{:.4}°", angle.to_degrees());
    if angle > 0.0 {
        let axis = rotation / angle;
        let _ = write!(text, " about ({:.4}, {:.4}, {:.4})", axis[0], axis[1], axis[2]);
    }
    text
}

fn summary(found: &Registration, args: &Args, source: &Path, target: &Path) -> String {
    let pose = &found.T_target_source;
    let mut text = format!("{} -> {}\n\nT_target_source\n", source.display(), target.display());
    for row in pose.to_rows() {
        // No minus before a zero.
        let [a, b, c, t] = row.map(|v| if v.abs() < 5e-7 { 0.0 } else { v });
        let _ = writeln!(text, "  {a:>10.6} {b:>10.6} {c:>10.6} {t:>15.6}");
    }

    let _ = writeln!(text, "\nrotation     {}", rotation(pose));
    let t = pose.translation;
    let _ = writeln!(text, "translation  ({:.6}, {:.6}, {:.6}), length {:.6}", t[0], t[1], t[2], t.norm());

    let p = found.probability;
    let _ = if found.is_trustworthy() {
        writeln!(text, "verdict      registered: the pose is right with probability {p:.3}")
    } else {
        writeln!(text, "verdict      not registered: the pose is right with a probability of only {p:.3}")
    };
    for reason in &found.reasons {
        let _ = writeln!(text, "caveat       {reason}");
    }
    if let Some(scale) = found.source_scale {
        let _ =
            writeln!(text, "             they fit once the source's lengths are multiplied by {scale:.6}");
    }
    for (rank, other) in found.alternatives.iter().enumerate() {
        let T = &other.T_target_source;
        let t = T.translation;
        let _ = writeln!(
            text,
            "alternative  {}: rotation {}, translation ({:.6}, {:.6}, {:.6}), score {:.3} of the best",
            rank + 1,
            rotation(T),
            t[0],
            t[1],
            t[2],
            other.relative_score
        );
    }
    for direction in &found.free_directions {
        let _ = writeln!(text, "free         {direction}");
    }
    let _ = writeln!(
        text,
        "fitness      {:.4} ({} points within one voxel of the target, rmse {:.6})",
        found.fitness, found.num_inliers, found.inlier_rmse
    );
    let _ = writeln!(
        text,
        "refinement   {} after {} iterations",
        if found.converged { "converged" } else { "not converged" },
        found.iterations
    );
    if found.settings.max_memory_bytes.is_some() {
        let [source, target] = found.points_used;
        let _ = writeln!(text, "points       {source} of the source and {target} of the target used");
    }
    let from = match (args.voxel_size, found.voxel_size) {
        (Some(_), _) => "given",
        (None, 0.0) => "not derived in time",
        (None, _) => "derived from the clouds",
    };
    let _ = writeln!(text, "voxel size   {:.6} ({from})", found.voxel_size);
    let ms = &found.timings_ms;
    let _ = writeln!(
        text,
        "time         {:.1} ms (prepare {:.1}, hypotheses {:.1}, refine {:.1}, verify {:.1}), reading not counted",
        ms.total, ms.prepare, ms.hypotheses, ms.refine, ms.verify
    );
    text
}
