//! Poses of many scans from poses of pairs: our solver beside those of other crates, on the same graphs.
//!
//! `[--scans 100,1000] [--wrong 0,0.1,0.2,0.4] [--seeds 3] [--runs 3] [--only upcr] [--merge TOLD.json [--least 0.5] [--poses FOLDER]]`

mod by_apex;
mod by_factrs;
mod graphs;
mod peer;

use std::cell::{Cell, RefCell};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::process::ExitCode;

use graphs::Known;
use nalgebra::{Matrix3, Vector3};
use peer::Found;
use upcr::Rigid;
use upcr::multiway::PoseGraph;

struct Args {
    scans: Vec<usize>,
    wrong: Vec<f64>,
    seeds: u64,
    runs: usize,
    only: Option<String>,
    merge: Option<PathBuf>,
    least: f64,
    poses: Option<PathBuf>,
}

fn parse() -> Result<Args, String> {
    let mut args = Args {
        scans: vec![100, 1000],
        wrong: vec![0.0, 0.1, 0.2, 0.4],
        seeds: 3,
        runs: 3,
        only: None,
        merge: None,
        least: upcr::TRUSTWORTHY,
        poses: None,
    };
    let mut words = std::env::args().skip(1);
    while let Some(word) = words.next() {
        let value = words.next().ok_or_else(|| format!("{word}: no value"))?;
        fn list<T: std::str::FromStr>(value: &str) -> Result<Vec<T>, String> {
            value.split(',').map(|v| v.parse().map_err(|_| format!("not a number: {v}"))).collect()
        }
        match word.as_str() {
            "--scans" => args.scans = list(&value)?,
            "--wrong" => args.wrong = list(&value)?,
            "--seeds" => args.seeds = list(&value)?[0],
            "--runs" => args.runs = list(&value)?[0],
            "--only" => args.only = Some(value),
            "--merge" => args.merge = Some(value.into()),
            "--least" => args.least = list(&value)?[0],
            "--poses" => args.poses = Some(value.into()),
            _ => return Err(format!("unknown: {word}")),
        }
    }
    Ok(args)
}

/// Rotation (degrees) and place of the centre (millimetres): root mean squares over the scans of the largest model, after the
/// motion that fits their places best.
struct Off {
    placed: usize,
    turn: f64,
    shift: f64,
}

fn off(known: &Known, found: &Found) -> Option<Off> {
    let truth = known.truth.as_ref()?;
    let kept = known.graph.edges.iter().zip(&found.kept).filter(|(_, kept)| **kept).map(|(e, _)| e);
    let first = peer::parts(truth.len(), kept);
    let mut sizes = vec![0; truth.len()];
    first.iter().for_each(|&f| sizes[f] += 1);
    let largest = (0..sizes.len()).rev().max_by_key(|&f| sizes[f])?;
    let scans: Vec<usize> = (0..truth.len()).filter(|&scan| first[scan] == largest).collect();
    let count = scans.len() as f64;
    let place = |pose: &Rigid, scan: usize| Vector3::from(pose.apply(known.graph.centers[scan]));
    let middle = |poses: &[Rigid]| scans.iter().map(|&s| place(&poses[s], s)).sum::<Vector3<f64>>() / count;
    let (from, to) = (middle(&found.poses), middle(truth));
    let spread: Matrix3<f64> = (scans.iter())
        .map(|&s| (place(&truth[s], s) - to) * (place(&found.poses[s], s) - from).transpose())
        .sum();
    let svd = spread.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let sign = (u * v_t).determinant().signum();
    let rotation = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t;
    let common = Rigid { rotation, translation: to - rotation * from };
    let (mut turn, mut shift) = (0.0, 0.0);
    for &scan in &scans {
        let pose = common * found.poses[scan];
        turn += (truth[scan].inverse() * pose).angle().to_degrees().powi(2);
        shift += (1e3 * (place(&pose, scan) - place(&truth[scan], scan))).norm_squared();
    }
    Some(Off { placed: scans.len(), turn: (turn / count).sqrt(), shift: (shift / count).sqrt() })
}

/// Ours; with the poses after its first step, which are near those along its tree.
fn ours(graph: &PoseGraph) -> (Found, Vec<Rigid>) {
    let (steps, first) = (Cell::new(0), RefCell::new(Vec::new()));
    let solution = graph.solve_heard(&|poses| {
        if steps.replace(steps.get() + 1) == 0 {
            *first.borrow_mut() = poses.to_vec();
        }
    });
    let kept = solution.edges.iter().map(|e| e.kept).collect();
    // The last time it is heard is no step.
    (Found { poses: solution.poses, kept, steps: steps.get() - 1 }, first.into_inner())
}

/// Seconds that a processor has worked on this thread, so that what else the machine does counts little.
fn worked() -> f64 {
    let told = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    told.split(' ').next().and_then(|ns| ns.parse::<f64>().ok()).map_or(f64::NAN, |ns| 1e-9 * ns)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// What one solver made of graphs alike but for their seeds.
#[derive(Default)]
struct Row {
    seconds: Vec<f64>,
    turns: Vec<f64>,
    shifts: Vec<f64>,
    placed: usize,
    wrong_kept: usize,
    right_dropped: usize,
    steps: Vec<f64>,
    failed: Vec<String>,
    varies: bool,
}

impl Row {
    fn add(&mut self, known: &Known, runs: usize, solve: &dyn Fn() -> Result<Found, String>) {
        let mut seconds = Vec::new();
        let mut first: Option<Found> = None;
        for _ in 0..runs {
            let start = worked();
            let found = catch_unwind(AssertUnwindSafe(solve)).unwrap_or_else(|_| Err("panic".into()));
            seconds.push(worked() - start);
            match found {
                Err(why) => {
                    self.failed.push(why);
                    return;
                }
                Ok(found) => self.varies |= *first.get_or_insert_with(|| found.clone()) != found,
            }
        }
        let Some(found) = first else { return };
        self.seconds.push(median(seconds));
        self.steps.push(found.steps as f64);
        if let Some(off) = off(known, &found) {
            self.placed += off.placed;
            self.turns.push(off.turn);
            self.shifts.push(off.shift);
        }
        for (&kept, &right) in found.kept.iter().zip(known.right.iter().flatten()) {
            self.wrong_kept += usize::from(kept && !right);
            self.right_dropped += usize::from(right && !kept);
        }
    }

    fn print(&self, graph: &str, solver: &str, [scans, wrong, right]: [usize; 3]) {
        let failed = if self.failed.is_empty() {
            String::new()
        } else {
            format!(" ({} failed: {})", self.failed.len(), self.failed[0])
        };
        println!(
            "| {graph} | {solver}{failed}{} | {:.3} | {:.0} | {} of {scans} | {:.3} | {:.1} | {} of {wrong} | {} of {right} |",
            if self.varies { " (differs between runs)" } else { "" },
            median(self.seconds.clone()),
            median(self.steps.clone()),
            self.placed,
            median(self.turns.clone()),
            median(self.shifts.clone()),
            self.wrong_kept,
            self.right_dropped,
        );
    }
}

fn compare(name: &str, graphs: &[Known], args: &Args) {
    let counts = [
        graphs.iter().map(|g| g.graph.centers.len()).sum(),
        graphs.iter().flat_map(|g| g.right.iter().flatten()).filter(|right| !**right).count(),
        graphs.iter().flat_map(|g| g.right.iter().flatten()).filter(|right| **right).count(),
    ];
    type Start = fn(&PoseGraph) -> Vec<Rigid>;
    let tree: Start = peer::along_a_tree;
    let same: Start = |graph| ours(graph).1;
    let peers: [(&str, &dyn peer::Minimiser, Start); 4] = [
        ("factrs", &by_factrs::Factrs, tree),
        ("factrs, our start", &by_factrs::Factrs, same),
        ("apex-solver", &by_apex::Apex { near: false }, tree),
        ("apex-solver, our start and width", &by_apex::Apex { near: true }, same),
    ];
    let asked = |solver: &str| args.only.as_ref().is_none_or(|only| solver.starts_with(only.as_str()));
    if asked("upcr") {
        let mut row = Row::default();
        for known in graphs {
            row.add(known, args.runs, &|| Ok(ours(&known.graph).0));
        }
        row.print(name, "upcr", counts);
    }
    for (solver, minimiser, start) in peers.into_iter().filter(|(solver, ..)| asked(solver)) {
        let mut row = Row::default();
        for known in graphs {
            let start = start(&known.graph);
            row.add(known, args.runs, &|| peer::solve(minimiser, &known.graph, &start));
        }
        row.print(name, solver, counts);
    }
}

fn run() -> Result<(), String> {
    let args = parse()?;
    if std::env::var("RAYON_NUM_THREADS").as_deref() != Ok("1") {
        eprintln!("not on one thread: set RAYON_NUM_THREADS=1, for apex-solver takes all there are");
    }
    // Solvers that give up by a panic are named in the table.
    std::panic::set_hook(Box::new(|_| ()));
    println!(
        "| graph | solver | seconds | steps | placed | rotation ° | place mm | wrong kept | right dropped |\n\
         | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
    );
    if let Some(path) = &args.merge {
        let known = graphs::of_merge(path, args.least, args.poses.as_deref())?;
        compare(&format!("merge, p ≥ {}", args.least), &[known], &args);
        return Ok(());
    }
    for &scans in &args.scans {
        for &wrong in &args.wrong {
            let graphs: Vec<Known> = (0..args.seeds).map(|seed| graphs::rooms(scans, wrong, seed)).collect();
            compare(&format!("{scans}, {:.0} %", 100.0 * wrong), &graphs, &args);
        }
    }
    Ok(())
}

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("{message}");
            ExitCode::FAILURE
        }
    }
}
