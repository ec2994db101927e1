//! `upcr train`, `adapt` and `eval` on a handful of small shapes.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use super::{Scratch, command, upcr};

/// Settings of a run of seconds.
pub(super) const SETTINGS: &str = "\
seed = 3
checkpoint_seconds = 0.0
validation_every_nth = 5
validation_steps = 20
stages = [
  { points = 48, k = 6, batch = 4, length = { steps = 60 } },
  { points = 64, batch = 4, length = { epochs = 6 } },
]
[network]
k = 8
widths = [8, 16, 32]
head = [16]
";

/// A folder with twelve boxes of different sides, each some points on its faces.
pub(super) fn shapes(scratch: &Scratch) -> String {
    let folder = scratch.path("shapes");
    std::fs::create_dir(&folder).unwrap();
    let mut state = 1_u64;
    let mut uniform = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f64 / (1_u64 << 24) as f64
    };
    for shape in 0..12 {
        let sides = [1.0, 0.4 + 0.5 * uniform(), 0.2 + 0.4 * uniform()];
        let points: Vec<[f64; 3]> = (0..1500)
            .map(|_| {
                let mut p = [uniform(), uniform(), uniform()];
                p[(3.0 * uniform()) as usize % 3] = (2.0 * uniform()).floor().min(1.0);
                std::array::from_fn(|axis| (p[axis] - 0.5) * sides[axis] + f64::from(axis == 0) * p[1] * p[2])
            })
            .collect();
        scratch.xyz(&format!("shapes/{shape:02}.xyz"), &points);
    }
    folder
}

/// The tensors of a safetensors file by name.
fn tensors(path: &str) -> BTreeMap<String, Vec<u8>> {
    let bytes = std::fs::read(path).unwrap();
    let header = u64::from_le_bytes(*bytes.first_chunk().unwrap()) as usize;
    let (header, data) = bytes[8..].split_at(header);
    let header: BTreeMap<String, serde_json::Value> = serde_json::from_slice(header).unwrap();
    let tensors = header.into_iter().filter(|(name, _)| name != "__metadata__");
    tensors
        .map(|(name, entry)| {
            let at = |i: usize| entry["data_offsets"][i].as_u64().unwrap() as usize;
            (name, data[at(0)..at(1)].to_vec())
        })
        .collect()
}

#[test]
fn a_killed_run_is_resumed_to_the_same_weights() {
    let scratch = Scratch::new();
    let (shapes, settings) = (shapes(&scratch), scratch.file("run.toml", SETTINGS));
    let start = |folder: &str| {
        vec!["train".into(), "--data".into(), shapes.clone(), "--config".into(), settings.clone()]
            .into_iter()
            .chain(["--protocol".into(), "mixed".into(), "--out".into(), folder.to_owned()])
            .collect::<Vec<String>>()
    };
    let whole = scratch.path("whole");
    let run = upcr(start(&whole));
    assert_eq!(run.status, 0, "{}", run.stderr);
    assert_eq!(run.stdout.trim(), format!("{whole}/weights.safetensors"));
    for file in ["run.toml", "history.csv", "history.svg"] {
        assert!(Path::new(&whole).join(file).exists(), "{file}");
    }

    let killed = scratch.path("killed");
    let mut child =
        command().args(start(&killed)).stderr(Stdio::null()).stdout(Stdio::null()).spawn().unwrap();
    let checkpoint = Path::new(&killed).join("checkpoint.safetensors");
    // Some way into the run, wherever that is on this machine.
    while !checkpoint.exists() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(Duration::from_millis(5));
    }
    std::thread::sleep(Duration::from_millis(u64::from(std::process::id() % 300)));
    // On Unix this is SIGKILL.
    child.kill().unwrap();
    child.wait().unwrap();
    let run = upcr(["train", "--resume", &killed]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    let [expected, found] =
        [&whole, &killed].map(|folder| std::fs::read(format!("{folder}/weights.safetensors")).unwrap());
    assert!(found == expected);

    upcr(start(&whole)).assert_fails(1, &["--resume"]);
}

#[test]
fn weights_are_adapted_and_evaluated() {
    let scratch = Scratch::new();
    let (shapes, settings) = (shapes(&scratch), scratch.file("run.toml", SETTINGS));
    let folder = scratch.path("run");
    let run = upcr(["train", "--data", &shapes, "--config", &settings, "--out", &folder]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    let weights = format!("{folder}/weights.safetensors");

    let out = scratch.path("adapted");
    let run = upcr([
        "adapt",
        "--weights",
        &weights,
        "--clouds",
        &shapes,
        "--protocol",
        "upc",
        "--points",
        "128",
        "--epochs",
        "3",
        "--learning-rate",
        "0.001",
        "--out",
        &out,
    ]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    let report: serde_json::Value =
        serde_json::from_slice(&std::fs::read(format!("{out}/adaptation.json")).unwrap()).unwrap();
    let loss = |when: &str| report[when]["loss"].as_f64().unwrap();
    assert_eq!(report["helped"].as_bool().unwrap(), loss("after") < loss("before"));
    let adapted = tensors(&format!("{out}/weights.safetensors"));
    assert_eq!(adapted != tensors(&weights), report["helped"].as_bool().unwrap());

    let results = scratch.path("results.json");
    let run = upcr([
        "eval",
        "--data",
        &shapes,
        "--protocol",
        "upc,nd",
        "--overlap",
        "consistent,partial_shared",
        "--methods",
        "upcr,icp,default",
        "--weights",
        &weights,
        "--out",
        &results,
    ]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    let report: serde_json::Value = serde_json::from_slice(&std::fs::read(&results).unwrap()).unwrap();
    let rows = report["results"].as_array().unwrap();
    assert_eq!(rows.len(), 12);
    for key in [
        "method",
        "protocol",
        "overlap",
        "noise",
        "pairs",
        "rmse_r_deg",
        "mae_r_deg",
        "rmse_t",
        "mae_t",
        "rre_mean_deg",
        "rte_mean",
        "me_bregier",
        "recall",
        "ms_per_pair",
    ] {
        assert!(rows.iter().all(|row| !row[key].is_null()), "{key}");
    }
    assert!(report["settings"]["version"].is_string());
    assert_eq!(run.stdout.lines().count(), 14);
    assert_eq!(std::fs::read_to_string(scratch.path("results.csv")).unwrap().lines().count(), 13);
}

#[test]
fn bad_requests_are_refused() {
    let scratch = Scratch::new();
    let shapes = shapes(&scratch);
    let bad = scratch.file("bad.toml", "stages = 3");
    let out = scratch.path("out");
    upcr(["train", "--data", &shapes, "--config", &bad, "--out", &out]).assert_fails(1, &["bad.toml"]);
    upcr(["train", "--data", &scratch.path("none"), "--out", &out]).assert_fails(1, &["none"]);
    upcr(["train", "--resume", &scratch.path("none")]).assert_fails(1, &["run.toml"]);
    let text = scratch.file("weights.safetensors", "no weights");
    upcr(["adapt", "--weights", &text, "--clouds", &shapes, "--out", &out])
        .assert_fails(1, &["weights.safetensors"]);
    upcr(["eval", "--data", &shapes, "--weights", &text]).assert_fails(1, &["weights.safetensors"]);
    upcr(["eval", "--data", &shapes, "--methods", "magic"]).assert_fails(1, &["magic"]);
    assert_eq!(upcr(["train", "--data", &shapes]).status, 2);
}

#[test]
fn other_networks_are_trained_and_evaluated() {
    let scratch = Scratch::new();
    let (shapes, settings) = (shapes(&scratch), scratch.file("run.toml", SETTINGS));
    let folder = scratch.path("run");
    let start = ["train", "--data", &shapes, "--config", &settings, "--network"];
    let narrow = ["pointnetlk", "--set", "network.widths=[8, 8, 8, 16, 32]", "--out", &folder];
    let run = upcr(start.into_iter().chain(narrow));
    assert_eq!(run.status, 0, "{}", run.stderr);

    let weights = format!("{folder}/weights.safetensors");
    let method = format!("lucas-kanade={weights}");
    let run = upcr(["eval", "--data", &shapes, "--methods", &method]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    assert!(run.stdout.contains("| lucas-kanade | "), "{}", run.stdout);

    upcr(start.into_iter().chain(["pointnet", "--out", &folder])).assert_fails(1, &["pointnetlk", "prnet*"]);
    upcr(["eval", "--data", &shapes, "--methods", "lucas-kanade=absent"]).assert_fails(1, &["absent"]);
    // Only UPCR's weights register.
    let cloud = format!("{shapes}/00.xyz");
    upcr(["register", &cloud, &cloud, "--weights", &weights])
        .assert_fails(1, &["another network", "pointnetlk"]);
    let adapt = ["adapt", "--weights", &weights, "--clouds", &shapes, "--out", &scratch.path("adapted")];
    upcr(adapt).assert_fails(1, &["without labels"]);
    // Ways to lose the results.
    let eval = ["eval", "--data", &shapes, "--methods"];
    upcr(eval.into_iter().chain(["icp", "--out", "a.csv"])).assert_fails(1, &["a.csv", "JSON"]);
    upcr(eval.into_iter().chain(["icp", "--out", &shapes])).assert_fails(1, &["a folder"]);
    upcr(eval.into_iter().chain(["=a"])).assert_fails(1, &["a name is wanted"]);
}

#[test]
fn a_run_on_few_shapes_has_none_to_hold_out_and_is_resumed() {
    let scratch = Scratch::new();
    let shapes = shapes(&scratch);
    let settings = SETTINGS.replace("validation_every_nth = 5", "validation_every_nth = 100");
    let (settings, folder) = (scratch.file("run.toml", &settings), scratch.path("run"));
    let run = upcr(["train", "--data", &shapes, "--config", &settings, "--out", &folder]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    assert!(!run.stderr.contains("NaN"), "{}", run.stderr);
    let run = upcr(["train", "--resume", &folder]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    upcr(["train", "--data", "absent", "--out", &scratch.path("none")]).assert_fails(1, &["absent"]);
    assert!(!Path::new(&scratch.path("none")).exists());
}

#[test]
fn what_is_no_published_network_is_not_imported() {
    let scratch = Scratch::new();
    let out = scratch.path("out.safetensors");
    let text = scratch.file("text.t7", "no pickle");
    upcr(["import", &text, "--out", &out]).assert_fails(1, &["text.t7"]);
    upcr(["import", "absent.t7", "--out", &out]).assert_fails(1, &["absent.t7"]);
    assert!(!Path::new(&out).exists());
}

const EXPERIMENT: &str = r#"
title = "A few boxes"
paper = "table"
data = ["absent", "shapes"]
seeds = 2
columns = ["rmse_r_deg", "mae_r_deg", "found"]
plot = { kind = "dots", measure = "mae_r_deg" }
[[setting]]
name = "clean"
[[setting]]
name = "partial, noisy"
overlap = "partial_shared"
noise = true
[[method]]
name = "ICP"
run = "icp"
paper.clean = { rmse_r_deg = 12.5 }
[[method]]
name = "UPCR"
network = "upcr"
changes = ["network.widths=[8, 8]"]
adapt = "tested"
[[method]]
name = "PointNetLK"
network = "pointnetlk"
settings = ["clean"]
"#;
const BUDGET: &str = "\
points = 64
neighbors = 6
narrow = true
batch = 3
pairs = 2
decay = \"cosine\"
[training]
upcr = { length = { steps = 30 }, learning_rate = 1e-3 }
pointnetlk = { length = { steps = 20 }, learning_rate = 1e-3 }
[adaptation]
length = { epochs = 4 }
learning_rate = 1e-3
";

/// What was measured, but for times.
fn measured(folder: &str) -> serde_json::Value {
    let text = std::fs::read_to_string(Path::new(folder).join("results.json")).unwrap();
    let results: serde_json::Value = serde_json::from_str(&text).unwrap();
    let mut cells = results["experiments"][0]["cells"].clone();
    for cell in cells.as_array_mut().unwrap() {
        let values = cell["values"].as_object_mut().unwrap();
        values.retain(|name, _| !name.starts_with("ms"));
    }
    cells
}

#[test]
fn experiments_are_reproduced_and_go_on_after_a_kill() {
    let scratch = Scratch::new();
    shapes(&scratch);
    let data = scratch.path("");
    let (experiment, budget) = (scratch.file("boxes.toml", EXPERIMENT), scratch.file("tiny.toml", BUDGET));
    let arguments = |out: &str| {
        ["reproduce", &experiment, "--budget", &budget, "--data", &data, "--out", out].map(str::to_owned)
    };
    let whole = scratch.path("whole");
    let run = upcr(arguments(&whole));
    assert_eq!(run.status, 0, "{}", run.stderr);
    let cells = measured(&whole);
    // Two seeds of UPCR in two settings, of PointNetLK in one; ICP has none.
    assert_eq!(cells.as_array().unwrap().len(), 2 + 4 + 2);
    let report = std::fs::read_to_string(run.stdout.trim()).unwrap();
    assert!(report.contains("| UPCR |") && report.contains(" ± ") && report.contains("12.500"), "{report}");
    let file = |extension: &str| std::fs::read(Path::new(&whole).join(format!("boxes.{extension}"))).unwrap();
    assert!(file("png").starts_with(b"\x89PNG") && file("svg").starts_with(b"<svg"));
    assert_eq!(String::from_utf8(file("csv")).unwrap().lines().count(), 1 + 8);

    // What is done is not done again.
    let again = upcr(arguments(&whole));
    assert_eq!((again.status, again.stderr.contains("training")), (0, false), "{}", again.stderr);
    assert_eq!(measured(&whole), cells);

    let killed = scratch.path("killed");
    let mut child =
        command().args(arguments(&killed)).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    while !Path::new(&killed).join("tests").exists() {
        std::thread::sleep(Duration::from_millis(5));
    }
    std::thread::sleep(Duration::from_millis(150));
    child.kill().unwrap();
    child.wait().unwrap();
    let resumed = upcr(arguments(&killed));
    assert_eq!(resumed.status, 0, "{}", resumed.stderr);
    assert_eq!(measured(&killed), cells);
}

#[test]
#[cfg(unix)]
fn a_reproduction_stops_when_it_is_told_to() {
    let scratch = Scratch::new();
    shapes(&scratch);
    let experiment = scratch.file("boxes.toml", EXPERIMENT);
    let budget = scratch.file("long.toml", BUDGET.replace("steps = 30", "steps = 1000000"));
    let out = scratch.path("out");
    let arguments =
        ["reproduce", &experiment, "--budget", &budget, "--data", &scratch.path(""), "--out", &out];
    let mut child = command().args(arguments).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    while !Path::new(&out).join("weights").exists() {
        std::thread::sleep(Duration::from_millis(5));
    }
    std::thread::sleep(Duration::from_millis(300));
    let interrupted = std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(interrupted.unwrap().success());
    assert_eq!(child.wait().unwrap().code(), Some(130));
    // What it goes on from.
    let folders = std::fs::read_dir(Path::new(&out).join("weights")).unwrap();
    let folder = folders.map(|entry| entry.unwrap().path()).next().unwrap();
    assert!(folder.join("checkpoint.safetensors").exists());
}

#[test]
fn what_cannot_be_reproduced_is_told() {
    let scratch = Scratch::new();
    let (data, out) = (scratch.path(""), scratch.path("out"));
    let run = upcr(["reproduce", "everything", "--data", &data, "--out", &out]);
    assert!(run.status == 1 && run.stderr.contains("there are consistent, partial"), "{}", run.stderr);
    let run = upcr(["reproduce", "consistent", "--budget", "endless", "--data", &data, "--out", &out]);
    assert!(run.status == 1 && run.stderr.contains("full, quick"), "{}", run.stderr);
    let run = upcr(["reproduce", "consistent", "--data", &scratch.path("nowhere"), "--out", &out]);
    assert!(run.status == 1 && run.stderr.contains("nowhere"), "{}", run.stderr);
    let run = upcr(["reproduce", "consistent", "--data", &data, "--out", &out]);
    assert!(run.status == 1 && run.stderr.contains("skipped consistent"), "{}", run.stderr);
    let report = std::fs::read_to_string(Path::new(&out).join("report.md")).unwrap();
    assert!(report.contains("Not done"), "{report}");
}
