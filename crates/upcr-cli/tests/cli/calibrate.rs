//! `upcr calibrate` on a handful of small shapes.

use super::learning::shapes;
use super::{Scratch, sample, upcr};

#[test]
fn what_is_fitted_is_used_and_told() {
    let scratch = Scratch::new();
    let (data, out, observed) = (shapes(&scratch), scratch.path("my.json"), scratch.path("observed.jsonl"));
    let fit = |threads: &str| {
        let words = ["calibrate", "fit", "--scenes", "0", "--pairs", "160", "--threads", threads];
        let run = upcr(words.into_iter().chain(["--data", &data, "--out", &out, "--observed", &observed]));
        assert_eq!(run.status, 0, "{}", run.stderr);
        assert!(run.stdout.starts_with("160 pairs, "), "{}", run.stdout);
        std::fs::read_to_string(&out).unwrap()
    };
    let text = fit("2");
    assert_eq!(fit("1"), text, "weights depend on the number of threads");
    let calibration: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert!(calibration["about"].as_str().unwrap().contains("160 pairs of shapes"), "{text}");
    assert_ne!(calibration["samples"]["of"]["near_misses"], 0.0);

    let lines = std::fs::read_to_string(&observed).unwrap();
    let pairs: Vec<serde_json::Value> =
        lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(pairs.len(), 160);
    // Right ones and wrong ones, and of things that are not the same all are wrong.
    let right = |pair: &&serde_json::Value| pair["right"] == true;
    assert!((20..140).contains(&pairs.iter().filter(right).count()));
    assert!(pairs.iter().filter(|pair| pair["kind"] == "different").all(|pair| pair["right"] == false));

    let asked = |calibration: &[&str]| {
        let files = [sample("source.ply"), sample("target.ply")];
        let words = ["register", files[0].as_str(), files[1].as_str(), "--json"];
        upcr(words.iter().chain(calibration)).json()
    };
    let (own, default) = (asked(&["--calibration", &out]), asked(&[]));
    assert_ne!(own["probability"], default["probability"]);
    assert_eq!(own["evidence"], default["evidence"]);
    // Points that are averages were not seen: there the default's weights stay.
    let library = upcr::Calibration::embedded().unwrap();
    assert_eq!(calibration["averages"], serde_json::to_value(&library.averages).unwrap());
    assert_eq!(own["settings"]["calibration"], calibration["about"]);
    assert!(default["settings"]["calibration"].is_null());
}

#[test]
fn a_test_writes_its_tables_and_pictures() {
    let scratch = Scratch::new();
    let (data, out) = (shapes(&scratch), scratch.path("trust"));
    let run = upcr(
        ["calibrate", "test", "--data", &data, "--pairs", "30", "--strangers", "6"].into_iter().chain([
            "--covariance",
            "10",
            "--free-axes",
            "1",
            "--out",
            &out,
        ]),
    );
    assert_eq!(run.status, 0, "{}", run.stderr);
    let report = std::fs::read_to_string(format!("{out}/report.md")).unwrap();
    assert_eq!(run.stdout, report);
    for heading in ["Probability", "By kind of pair", "nothing in common", "Covariance", "Free directions"] {
        assert!(report.contains(heading), "{heading} is missing in {report}");
    }
    let results = std::fs::read_to_string(format!("{out}/results.json")).unwrap();
    let results: serde_json::Value = serde_json::from_str(&results).unwrap();
    let counts = &results["trust"]["reliability"][0][1]["counts"];
    assert_eq!(counts["pairs"], 30);
    assert_eq!(results["trust"]["strangers"][0][1]["pairs"], 6);
    assert_eq!(&std::fs::read(format!("{out}/reliability.png")).unwrap()[1..4], b"PNG");
    assert!(std::fs::read_to_string(format!("{out}/reliability.svg")).unwrap().contains("<circle"));
}

#[test]
fn what_cannot_be_fitted_or_used_is_refused() {
    let scratch = Scratch::new();
    let out = scratch.path("my.json");
    upcr(["calibrate", "fit", "--scenes", "0", "--out", &out]).assert_fails(1, &["no pairs"]);
    let empty = scratch.path("empty");
    std::fs::create_dir(&empty).unwrap();
    upcr(["calibrate", "fit", "--data", &empty, "--out", &out]).assert_fails(1, &["empty", "NAME.pose.txt"]);
    let broken = scratch.file("broken.json", "{\"about\": \"\"}");
    let files = [sample("source.ply"), sample("target.ply")];
    upcr(["register", &files[0], &files[1], "--calibration", &broken])
        .assert_fails(1, &["broken.json", "calibration"]);
}
