//! `upcr merge`: many scans into one model.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs::{self, File, OpenOptions};
use std::io::{BufRead, BufReader, Write as _};
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::UNIX_EPOCH;

use anyhow::{Context, Result, bail};
use serde::{Deserialize, Serialize};
use upcr::multiway::{
    Attempt, MergeProgress, MergeSettings, MergeStep, MergeWatch, Merged, Place, Scans, fuse, merge,
};
use upcr::transform::quaternion;
use upcr::{Calibration, Method, PointCloud, Rigid, Settings, io};
use upcr_lab::files::write_atomically;
use upcr_report::MergePage;

use crate::output::{self, Progress};
use crate::stream::{Alignment, Layout, Streaming};
use crate::{Status, input};

/// Put many scans into one model: unordered, each in a frame of its own
#[derive(clap::Args)]
pub struct Args {
    /// A folder, of which every file of a known format is a scan, or the scans
    #[arg(required = true, value_name = "SCANS")]
    scans: Vec<PathBuf>,
    /// Where the merged cloud goes; scans that nothing joins to it become models of their own, MODEL_2 and so on
    #[arg(short, long, value_name = "MODEL")]
    output: PathBuf,
    /// Write the poses, scan into model: a `.json` of file names and 4x4 matrices, or a `.txt` of TUM lines, numbered as the
    /// scans are
    #[arg(long, value_name = "FILE")]
    poses: Option<PathBuf>,
    /// Write a report: one HTML page, which needs no network, with the models in 3-D, the graph of the pairs, and why each was
    /// kept or not
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// The scans are in the order in which they were taken
    #[arg(long)]
    sequential: bool,
    /// Scans that each is registered with, of those that look most like it
    #[arg(long, value_name = "N", default_value_t = MergeSettings::default().neighbors)]
    neighbors: usize,
    /// Where the first poses of pairs come from
    #[arg(long, value_enum, default_value_t = Settings::default().method)]
    method: Method,
    /// The one scale that drives every radius, in the scans' unit [default: derived from the scans]
    #[arg(long, value_name = "LENGTH")]
    voxel_size: Option<f64>,
    /// Edge of the merged cloud's cells, of which each has one point [default: the voxel size]
    #[arg(long, value_name = "LENGTH")]
    thin: Option<f64>,
    /// Memory that scans may take at once, e.g. `512M` or `2G` [default: 2G]
    #[arg(long, value_name = "BYTES", value_parser = input::bytes)]
    max_memory: Option<u64>,
    /// Weights of the evidence for and against a pose, as `upcr calibrate fit` writes them [default: those in the program]
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// Seed of every random choice
    #[arg(long, default_value_t = Settings::default().seed)]
    seed: u64,
    /// Threads to use; the result does not depend on it [default: all]
    #[arg(long)]
    threads: Option<NonZeroUsize>,
    #[command(flatten)]
    stream: Streaming,
    /// Print one JSON object instead of a summary
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    reading: input::Reading,
}

/// Scans as files.
struct Files<'a> {
    paths: Vec<PathBuf>,
    reading: &'a input::Reading,
}

impl Scans for Files<'_> {
    fn len(&self) -> usize {
        self.paths.len()
    }

    fn read(&self, scan: usize) -> upcr::Result<PointCloud> {
        self.reading.read(&self.paths[scan])
    }
}

pub fn run(args: &Args) -> Result<Status> {
    io::check_writable(&args.output)?;
    for path in [Some(&args.output), args.poses.as_ref(), args.report.as_ref()].into_iter().flatten() {
        output::check_folder(path)?;
    }
    let files = Files { paths: found(&args.scans, &args.output)?, reading: &args.reading };
    let settings = MergeSettings {
        registration: Settings {
            method: args.method,
            voxel_size: args.voxel_size,
            calibration: args.calibration.as_ref().map(Calibration::load).transpose()?.map(Arc::new),
            seed: args.seed,
            threads: args.threads,
            ..Settings::default()
        },
        neighbors: args.neighbors,
        sequential: args.sequential,
        max_memory_bytes: args.max_memory,
    };
    let paths: Vec<&Path> = files.paths.iter().map(PathBuf::as_path).collect();
    let names = input::short_names(&paths);
    let layout = Layout { clouds: true, curves: &["pairs"], words: true };
    let stream = args.stream.open("merge", &layout)?;
    let shown = stream.map(|stream| Alignment::new(stream, &files, &names));
    let journal = Journal::open(&args.output, &files.paths, &settings)?;
    let progress = Mutex::new(Progress::new());
    let step = |what: &str| {
        if let Ok(mut progress) = progress.lock() {
            progress.step(what);
        }
    };
    let tell = |MergeProgress { step: at, done, of }: MergeProgress| {
        let what = match at {
            MergeStep::Describe => "reading scans",
            MergeStep::Register => "registering pairs",
        };
        step(&format!("{what}: {done} of {of}"));
    };
    let pair = |attempt: &Attempt| {
        if let Some(shown) = &shown {
            shown.pair(attempt);
        }
        journal.append(attempt)
    };
    let aligned = |poses: &[Rigid]| {
        if let Some(shown) = &shown {
            shown.poses(poses);
        }
    };
    let watch = MergeWatch { pair: &pair, progress: &tell, alignment: &aligned };
    let merged = merge(&files, &settings, &journal.known, &watch)?;

    let mut models: Vec<Vec<(usize, Rigid)>> = Vec::new();
    for (scan, place) in merged.places.iter().enumerate() {
        if let Place::Placed { model, T_model_scan, .. } = place {
            models.resize(models.len().max(model + 1), Vec::new());
            models[*model].push((scan, *T_model_scan));
        }
    }
    for (number, scans) in models.iter().enumerate() {
        let told = |done: usize| step(&format!("merging: {done} of {}", scans.len()));
        let cloud = fuse(&files, scans, args.thin.unwrap_or(merged.voxel_size), &told)?;
        io::write_cloud(numbered(&args.output, number), &cloud)?;
        if let Some(path) = &args.poses {
            write_poses(&numbered(path, number), scans, &names)?;
        }
    }
    if let Some(path) = &args.report {
        let told = |done: usize| step(&format!("writing the report: {done} of {}", names.len()));
        let html = MergePage::new(&merged, &names).html(&files, &told)?;
        write_atomically(path, html.as_bytes())?;
    }
    journal.done()?;
    drop(progress);
    let told = told(&merged, &names, &models);
    let summary = summary(&told, args);
    if let Some(shown) = shown {
        shown.end(&summary)?;
    }
    if args.json {
        output::answer_json(&told)?;
    } else {
        output::answer(&summary)?;
    }
    let whole = models.len() == 1 && told.left_out.is_empty();
    Ok(if whole { Status::Done } else { Status::NotRegistered })
}

/// The scans, each once, a folder's in the order of their names; without what an earlier call wrote.
fn found(given: &[PathBuf], output: &Path) -> Result<Vec<PathBuf>> {
    let mut paths = Vec::new();
    for path in given {
        if path.is_dir() {
            let mut inside = scans_in(path)?;
            inside.retain(|p| !is_model(p, output));
            if inside.is_empty() {
                bail!("{}: there is no scan in it", path.display());
            }
            paths.append(&mut inside);
        } else {
            paths.push(path.clone());
        }
    }
    let mut seen = std::collections::HashSet::new();
    paths.retain(|path| seen.insert(path.clone()));
    if paths.len() < 2 {
        bail!("two scans are needed at least");
    }
    Ok(paths)
}

/// The scans of a folder, in the order of their names: every file of a known format that holds no pose.
///
/// # Errors
/// Where the folder cannot be read.
pub fn scans_in(folder: &Path) -> upcr::Result<Vec<PathBuf>> {
    let mut inside: Vec<PathBuf> = fs::read_dir(folder)
        .and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect())
        .map_err(|source| upcr::Error::Io { path: folder.to_owned(), source })?;
    inside.retain(|p| p.is_file() && io::format_name(p).is_some());
    // Poses lie beside scans, and their four lines of numbers read as points too.
    inside.retain(|p| io::read_transform(p).is_err());
    inside.sort();
    Ok(inside)
}

/// Whether a file has the name of one of the models that `output` stands for.
fn is_model(path: &Path, output: &Path) -> bool {
    let folder = |file: &Path| {
        let parent = file.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
        fs::canonicalize(parent).ok()
    };
    let (Some(stem), Some(model)) =
        (path.file_stem().and_then(|s| s.to_str()), output.file_stem().and_then(|s| s.to_str()))
    else {
        return false;
    };
    let rest = stem.strip_prefix(model);
    let number = rest.and_then(|rest| rest.strip_prefix('_')).is_some_and(|n| n.parse::<usize>().is_ok());
    folder(path) == folder(output) && path.extension() == output.extension() && (rest == Some("") || number)
}

/// `model.ply`, `model_2.ply` and so on.
fn numbered(path: &Path, number: usize) -> PathBuf {
    if number == 0 {
        return path.to_owned();
    }
    let mut name = path.file_stem().unwrap_or_default().to_owned();
    name.push(format!("_{}", number + 1));
    if let Some(extension) = path.extension() {
        name.push(".");
        name.push(extension);
    }
    path.with_file_name(name)
}

fn write_poses(path: &Path, scans: &[(usize, Rigid)], names: &[String]) -> Result<()> {
    let text = if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json")) {
        let poses: BTreeMap<&str, &Rigid> =
            scans.iter().map(|(scan, pose)| (names[*scan].as_str(), pose)).collect();
        serde_json::to_string_pretty(&poses)? + "\n"
    } else {
        let mut text = String::from("# scan x y z qx qy qz qw\n");
        for (scan, pose) in scans {
            let [w, x, y, z] = quaternion::from_rotation(&pose.rotation);
            let t = pose.translation;
            let _ = writeln!(text, "{scan} {} {} {} {x} {y} {z} {w}", t[0], t[1], t[2]);
        }
        text
    };
    write_atomically(path, text.as_bytes())?;
    Ok(())
}

/// What is told of a merge.
#[derive(Serialize)]
struct Told<'a> {
    voxel_size: f64,
    covariance_inflation: f64,
    models: Vec<Vec<ToldScan<'a>>>,
    left_out: Vec<LeftOut<'a>>,
    pairs: Vec<ToldPair<'a>>,
}

#[derive(Serialize)]
struct ToldScan<'a> {
    name: &'a str,
    T_model_scan: Rigid,
    pairs: usize,
    probability: f64,
}

#[derive(Serialize)]
struct LeftOut<'a> {
    name: &'a str,
    reason: &'a str,
}

#[derive(Serialize)]
struct ToldPair<'a> {
    source_name: &'a str,
    target_name: &'a str,
    kept: bool,
    contradicted: bool,
    chi_sq: Option<f64>,
    #[serde(flatten)]
    attempt: &'a Attempt,
}

fn told<'a>(merged: &'a Merged, names: &'a [String], models: &[Vec<(usize, Rigid)>]) -> Told<'a> {
    let scan = |&(scan, T_model_scan): &(usize, Rigid)| match merged.places[scan] {
        Place::Placed { pairs, probability, .. } => {
            ToldScan { name: &names[scan], T_model_scan, pairs, probability }
        }
        _ => ToldScan { name: &names[scan], T_model_scan, pairs: 0, probability: 0.0 },
    };
    Told {
        voxel_size: merged.voxel_size,
        covariance_inflation: merged.inflation,
        models: models.iter().map(|scans| scans.iter().map(scan).collect()).collect(),
        left_out: (merged.places.iter().zip(names))
            .filter_map(|(place, name)| Some(LeftOut { name, reason: place.reason()? }))
            .collect(),
        pairs: (merged.pairs.iter())
            .map(|pair| ToldPair {
                source_name: &names[pair.attempt.source],
                target_name: &names[pair.attempt.target],
                kept: pair.kept,
                contradicted: pair.contradicted,
                chi_sq: pair.chi_sq,
                attempt: &pair.attempt,
            })
            .collect(),
    }
}

fn summary(told: &Told, args: &Args) -> String {
    let mut text = String::new();
    for (number, scans) in told.models.iter().enumerate() {
        let path = numbered(&args.output, number);
        let _ = writeln!(text, "{}: {} scans", path.display(), scans.len());
        for scan in scans {
            let _ =
                writeln!(text, "  {}  {} pairs, probability {:.3}", scan.name, scan.pairs, scan.probability);
        }
    }
    if !told.left_out.is_empty() {
        text.push_str("left out:\n");
        for LeftOut { name, reason } in &told.left_out {
            let _ = writeln!(text, "  {name}  {reason}");
        }
    }
    let kept = told.pairs.iter().filter(|pair| pair.kept).count();
    let _ = writeln!(text, "pairs        {} registered, {kept} kept", told.pairs.len());
    let dropped = |pair: &&ToldPair| pair.chi_sq.is_some() && !pair.kept;
    name_pairs(&mut text, "trusted as pairs, and at odds with the others", told, dropped);
    let contradicted = |pair: &&ToldPair| pair.contradicted;
    name_pairs(
        &mut text,
        "trusted as pairs, and what they lay on each other speaks against them",
        told,
        contradicted,
    );
    let _ = writeln!(text, "voxel size   {}", told.voxel_size);
    text
}

/// The pairs that are `such`, where there are any.
fn name_pairs(text: &mut String, what: &str, told: &Told, such: impl Fn(&&ToldPair) -> bool) {
    let pairs: Vec<&ToldPair> = told.pairs.iter().filter(such).collect();
    if pairs.is_empty() {
        return;
    }
    let _ = writeln!(text, "{what}:");
    for pair in pairs {
        let ToldPair { source_name, target_name, attempt, .. } = pair;
        let _ = writeln!(text, "  {source_name} -> {target_name}  probability {:.3}", attempt.probability);
    }
}

/// Pairs that were registered, kept on disk until the model is there: who stops a merge goes on where it was.
struct Journal {
    path: PathBuf,
    file: Mutex<File>,
    known: Vec<Attempt>,
}

/// What pairs are of: where it differs, they are of no use.
#[derive(PartialEq, Serialize, Deserialize)]
struct Head {
    version: String,
    settings: String,
    /// Name, length in bytes and time of the last change of each scan.
    scans: Vec<(String, u64, u128)>,
}

impl Journal {
    fn open(output: &Path, scans: &[PathBuf], settings: &MergeSettings) -> Result<Self> {
        let mut path = output.as_os_str().to_owned();
        path.push(".pairs");
        let path = PathBuf::from(path);
        // Threads change nothing.
        let registration = Settings { threads: None, ..settings.registration.clone() };
        let head = Head {
            version: env!("CARGO_PKG_VERSION").into(),
            settings: format!(
                "{:?}",
                MergeSettings { registration, max_memory_bytes: None, ..settings.clone() }
            ),
            scans: scans.iter().map(|scan| stamp(scan)).collect::<Result<_>>()?,
        };
        let named = || path.display().to_string();
        let known = read_journal(&path, &head).with_context(named)?;
        // Begun anew with what is whole, so that a line cut short by a crash does not stay.
        let mut text = serde_json::to_string(&head)? + "\n";
        for attempt in &known {
            text += &serde_json::to_string(attempt)?;
            text.push('\n');
        }
        write_atomically(&path, text.as_bytes())?;
        let file = OpenOptions::new().append(true).open(&path).with_context(named)?;
        Ok(Self { path, file: Mutex::new(file), known })
    }

    fn append(&self, attempt: &Attempt) -> upcr::Result<()> {
        let write = || -> std::io::Result<()> {
            let mut line = serde_json::to_string(attempt)?;
            line.push('\n');
            let mut file = self.file.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
            file.write_all(line.as_bytes())
        };
        write().map_err(|source| upcr::Error::Io { path: self.path.clone(), source })
    }

    fn done(&self) -> Result<()> {
        fs::remove_file(&self.path).with_context(|| self.path.display().to_string())
    }
}

fn stamp(path: &Path) -> Result<(String, u64, u128)> {
    let data = fs::metadata(path).with_context(|| path.display().to_string())?;
    let changed =
        data.modified().ok().and_then(|t| t.duration_since(UNIX_EPOCH).ok()).map_or(0, |d| d.as_nanos());
    Ok((path.display().to_string(), data.len(), changed))
}

fn read_journal(path: &Path, head: &Head) -> Result<Vec<Attempt>> {
    let file = match File::open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(error.into()),
    };
    let mut lines = BufReader::new(file).lines();
    let first = lines.next().transpose()?.unwrap_or_default();
    if serde_json::from_str::<Head>(&first).ok().as_ref() != Some(head) {
        bail!("pairs of other scans or settings: remove it to begin anew");
    }
    // The last line may have been cut short.
    Ok(lines.map_while(|line| serde_json::from_str(&line.ok()?).ok()).collect())
}
