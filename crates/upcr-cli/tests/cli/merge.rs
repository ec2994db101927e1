//! `upcr merge`.

use std::fs;
use std::process::Stdio;
use std::time::{Duration, Instant};

use crate::{Scratch, command, upcr};

/// Scans of one object, and where they lie: `upcr synth` makes them.
fn scans(scratch: &Scratch, count: &str) -> String {
    let folder = scratch.path("scans");
    let run = upcr([
        "synth", "--scene", "object", "--scans", count, "--size", "160x120", "--seed", "4", "--out", &folder,
    ]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    folder
}

#[test]
fn a_folder_becomes_a_model_with_poses() {
    let scratch = Scratch::new();
    let folder = scans(&scratch, "6");
    let [model, poses] = ["model.ply", "poses.json"].map(|name| scratch.path(name));
    let run = upcr(["merge", &folder, "-o", &model, "--poses", &poses, "--json"]);
    assert!([0, 3].contains(&run.status), "{}", run.stderr);
    let told = run.json();
    let placed = told["models"][0].as_array().unwrap();
    assert!(placed.len() >= 4, "{told}");
    let written: serde_json::Value = serde_json::from_str(&fs::read_to_string(&poses).unwrap()).unwrap();
    assert_eq!(written.as_object().unwrap().len(), placed.len());
    for scan in placed {
        assert_eq!(written[scan["name"].as_str().unwrap()], scan["T_model_scan"]);
    }
    let info = upcr(["info", &model, "--json"]).json();
    assert!(info["points"].as_u64().unwrap() > 1000);
    assert!(!fs::exists(format!("{model}.pairs")).unwrap());

    // Into the folder of the scans: what a call wrote is no scan of the next. TUM lines are numbered as the scans are.
    let (inside, lines) = (format!("{folder}/model.ply"), scratch.path("poses.txt"));
    for _ in 0..2 {
        let again = upcr(["merge", &folder, "-o", &inside, "--poses", &lines, "--json", "--threads", "1"]);
        assert_eq!(again.json()["models"], told["models"]);
    }
    let text = fs::read_to_string(&lines).unwrap();
    assert_eq!(text.lines().filter(|line| !line.starts_with('#')).count(), placed.len());
    assert!(text.lines().skip(1).all(|line| line.split(' ').count() == 8), "{text}");
}

/// A 4×4 matrix that `upcr synth` wrote.
fn matrix(path: &str) -> [[f64; 4]; 4] {
    let text = fs::read_to_string(path).unwrap();
    let values: Vec<f64> = text.split_whitespace().map(|word| word.parse().unwrap()).collect();
    std::array::from_fn(|r| std::array::from_fn(|c| values[4 * r + c]))
}

fn product(a: &[[f64; 4]; 4], b: &[[f64; 4]; 4]) -> [[f64; 4]; 4] {
    std::array::from_fn(|r| std::array::from_fn(|c| (0..4).map(|k| a[r][k] * b[k][c]).sum()))
}

/// Where scans are known from where they were seen, rooms that look alike are told apart.
#[test]
fn rooms_that_look_alike_are_not_taken_for_each_other() {
    let scratch = Scratch::new();
    let folder = scratch.path("building");
    let run =
        upcr(["synth", "--scene", "building", "--scans", "16", "--turned", "--seed", "2", "--out", &folder]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    let model = scratch.path("model.ply");
    let told = upcr(["merge", &folder, "-o", &model, "--viewpoint", "0,0,0", "--json"]).json();
    let world = |name: &serde_json::Value| {
        let number = name.as_str().unwrap().trim_matches(|c: char| !c.is_ascii_digit());
        matrix(&format!("{folder}/T_world_{number}.txt"))
    };
    let mut kept = 0;
    for pair in told["pairs"].as_array().unwrap().iter().filter(|pair| pair["kept"] == true) {
        kept += 1;
        let found: [[f64; 4]; 4] = serde_json::from_value(pair["T_target_source"].clone()).unwrap();
        // Where the pair lays the source in the world.
        let laid = product(&world(&pair["target_name"]), &found);
        let truth = world(&pair["source_name"]);
        let off: f64 = (0..3).map(|k| (laid[k][3] - truth[k][3]).powi(2)).sum::<f64>().sqrt();
        let cosine: f64 = (0..3).map(|r| (0..3).map(|c| laid[r][c] * truth[r][c]).sum::<f64>()).sum::<f64>();
        assert!(off < 0.3 && (cosine - 1.0) / 2.0 > 0.996, "{} {}", pair["source_name"], pair["target_name"]);
    }
    assert!(kept >= 10, "{kept}");
}

#[test]
fn a_report_is_written_whatever_became_of_the_scans() {
    let scratch = Scratch::new();
    let folder = scans(&scratch, "5");
    let [model, report] = ["model.ply", "merge.html"].map(|name| scratch.path(name));
    let run = upcr(["merge", &folder, "-o", &model, "--report", &report, "--json"]);
    assert!([0, 3].contains(&run.status), "{}", run.stderr);
    let html = fs::read_to_string(&report).unwrap();
    let (_, words) = html.split_once("id=\"page\">").unwrap();
    let page: serde_json::Value = serde_json::from_str(words.split_once("</script>").unwrap().0).unwrap();
    let told = run.json();
    assert_eq!(page["merge"]["pairs"].as_array().unwrap().len(), told["pairs"].as_array().unwrap().len());
    for (scan, place) in
        page["scans"].as_array().unwrap().iter().zip(page["merge"]["places"].as_array().unwrap())
    {
        let of = told["models"].as_array().unwrap().iter().flat_map(|m| m.as_array().unwrap());
        let placed = of.clone().find(|other| other["name"] == scan["name"]);
        assert_eq!(placed.map(|other| &other["T_model_scan"]), place.get("T_model_scan"));
    }
    assert!(html.contains("id=\"points-0\"") && html.contains("default-src 'none'"));

    // Nothing has a place.
    let [one, two] = ["one.xyz", "two.xyz"].map(|name| scratch.file(name, "1 2 3\n4 5 6\n7 8 9\n"));
    let run = upcr(["merge", &one, &two, "-o", &scratch.path("none.ply"), "--report", &report]);
    assert_eq!(run.status, 3);
    let html = fs::read_to_string(&report).unwrap();
    assert!(html.contains("one.xyz") && !html.contains("id=\"points-0\""));

    // Where it cannot be written, it is said before the work.
    let nowhere = scratch.path("nowhere/merge.html");
    upcr(["merge", &folder, "-o", &model, "--report", &nowhere]).assert_fails(1, &["there is no folder"]);
}

#[test]
fn what_was_stopped_goes_on() {
    let scratch = Scratch::new();
    let folder = scans(&scratch, "6");
    let [whole, model] = ["whole.ply", "model.ply"].map(|name| scratch.path(name));
    let told = upcr(["merge", &folder, "-o", &whole, "--json"]).json();

    let mut child = command()
        .args(["merge", &folder, "-o", &model, "--threads", "1"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let journal = format!("{model}.pairs");
    let lines = || fs::read_to_string(&journal).map_or(0, |text| text.lines().count());
    let late = Instant::now() + Duration::from_secs(60);
    while lines() < 3 && child.try_wait().unwrap().is_none() && Instant::now() < late {
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    // A line that was cut short is begun anew.
    if fs::exists(&journal).unwrap() {
        let text = fs::read_to_string(&journal).unwrap();
        fs::write(&journal, &text[..text.len() - 10]).unwrap();
    }
    assert_eq!(upcr(["merge", &folder, "-o", &model, "--json"]).json(), told);

    fs::write(&journal, "{}\n").unwrap();
    upcr(["merge", &folder, "-o", &model]).assert_fails(1, &["model.ply.pairs", "other scans or settings"]);
}

#[test]
fn what_cannot_be_merged_is_refused() {
    let scratch = Scratch::new();
    let empty = scratch.path("empty");
    fs::create_dir(&empty).unwrap();
    let model = scratch.path("model.ply");
    upcr(["merge", &empty, "-o", &model]).assert_fails(1, &["no scan in it"]);
    let one = scratch.file("one.xyz", "1 2 3\n");
    upcr(["merge", &one, "-o", &model]).assert_fails(1, &["two scans"]);
    upcr(["merge", &one, &one, "-o", &scratch.path("model.docx")]).assert_fails(1, &["docx"]);
    let gone = scratch.path("gone.xyz");
    upcr(["merge", &one, &gone, "-o", &model]).assert_fails(1, &["gone.xyz"]);

    // Scans of no use are named, and nothing is written.
    let two = scratch.file("two.xyz", "1 2 3\n4 5 6\n7 8 9\n");
    let run = upcr(["merge", &one, &two, "-o", &model]);
    assert_eq!(run.status, 3);
    assert!(run.stdout.contains("left out:") && run.stdout.contains("two.xyz"), "{}", run.stdout);
    assert!(!fs::exists(&model).unwrap());
}
