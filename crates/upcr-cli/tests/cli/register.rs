//! `upcr register` on clouds that can be registered.

use serde_json::Value;

use crate::{Scratch, command, numbers, pose_error, sample, surface, upcr};

fn matrix(value: &Value) -> Vec<f64> {
    let rows = value.as_array().expect("a matrix is a list of rows");
    assert_eq!(rows.len(), 4);
    rows.iter()
        .flat_map(|row| {
            let row = row.as_array().expect("a row is a list");
            assert_eq!(row.len(), 4);
            row.iter().map(|v| v.as_f64().expect("an entry is a number"))
        })
        .collect()
}

#[test]
fn the_sample_pair_is_laid_on_its_truth() {
    let run = upcr(["register", &sample("source.ply"), &sample("target.ply"), "--json"]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    assert_eq!(run.stderr, "");
    let answer = run.json();
    let truth = numbers(sample("T_target_source.txt"));
    let (degrees, offset) = pose_error(&matrix(&answer["T_target_source"]), &truth);
    let voxel = answer["voxel_size"].as_f64().unwrap();
    assert!(degrees < 1.0 && offset < 2.0 * voxel, "off by {degrees}° and {offset} (voxel size {voxel})");
}

#[test]
fn json_is_one_complete_object() {
    let run = upcr(["register", &sample("source.ply"), &sample("target.ply"), "--json", "--seed", "7"]);
    let answer = run.json();
    for key in ["fitness", "inlier_rmse", "probability", "voxel_size"] {
        assert!(answer[key].is_f64(), "{key}: {}", answer[key]);
    }
    for key in ["num_inliers", "iterations"] {
        assert!(answer[key].is_u64(), "{key}: {}", answer[key]);
    }
    assert_eq!(matrix(&answer["T_target_source"])[12..], [0.0, 0.0, 0.0, 1.0]);
    assert!(answer["converged"].is_boolean());
    assert!(answer["reasons"].is_array());
    assert!(answer["method"].is_string());
    assert_eq!(answer["covariance"].as_array().map(Vec::len), Some(6));
    assert_eq!(answer["settings"]["seed"], 7);
    for key in ["method", "refine", "voxel_size", "init", "kernel", "overlap", "locks", "threads"] {
        assert!(answer["settings"].get(key).is_some(), "settings lacks {key}");
    }
    for key in ["prepare", "hypotheses", "refine", "verify", "total"] {
        assert!(answer["timings_ms"][key].is_f64(), "timings_ms.{key}: {}", answer["timings_ms"][key]);
    }
}

#[test]
fn told_where_the_sensors_stood_it_looks_for_free_space() {
    let share = |more: &[&str]| {
        let (source, target) = (sample("source.ply"), sample("target.ply"));
        let args = ["register", &source, &target, "--json"];
        upcr(args.iter().chain(more)).json()["evidence"]["in_free_space"].clone()
    };
    assert!(share(&[]).is_null());
    assert!(share(&["--viewpoint", "-1,0.5,2e1"]).is_f64());
    let run = |place: &str| upcr(["info", &sample("source.ply"), "--viewpoint", place]);
    assert!(run("1,2,3").stdout.contains("viewpoint"));
    assert_eq!(run("1,2").status, 2);
    assert_eq!(run("1,2,inf").status, 2);
}

#[test]
fn the_summary_says_what_the_json_says() {
    let run = upcr(["register", &sample("source.ply"), &sample("target.ply")]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    for word in
        ["T_target_source", "rotation", "translation", "verdict", "probability", "rmse", "voxel size", "time"]
    {
        assert!(run.stdout.contains(word), "`{word}` is missing in:\n{}", run.stdout);
    }
}

#[test]
fn the_answer_does_not_depend_on_the_threads() {
    let pose = |threads| {
        let run =
            upcr(["register", &sample("source.ply"), &sample("target.ply"), "--json", "--threads", threads]);
        matrix(&run.json()["T_target_source"])
    };
    assert_eq!(pose("1"), pose("2"));
}

#[test]
fn the_outputs_hold_the_pose_and_the_moved_source() {
    let scratch = Scratch::new();
    let (cloud, pose) = (scratch.path("aligned.ply"), scratch.path("T.txt"));
    let run = upcr([
        "register",
        &sample("source.ply"),
        &sample("target.ply"),
        "--json",
        "-o",
        &cloud,
        "--transform",
        &pose,
    ]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    assert_eq!(scratch.names(), ["T.txt", "aligned.ply"]);
    let found = matrix(&run.json()["T_target_source"]);
    let written = numbers(&pose);
    assert_eq!(written.len(), 16);
    assert!(written.iter().zip(&found).all(|(a, b)| (a - b).abs() < 1e-12), "{written:?} {found:?}");

    // What was written is read again: the moved source lies where it is, and the pose is a good first guess.
    let again = upcr(["register", &cloud, &sample("target.ply"), "--json"]);
    let identity: Vec<f64> = (0..16).map(|i| f64::from(u8::from(i % 5 == 0))).collect();
    let (degrees, offset) = pose_error(&matrix(&again.json()["T_target_source"]), &identity);
    let voxel = again.json()["voxel_size"].as_f64().unwrap();
    assert!(degrees < 1.0 && offset < 2.0 * voxel, "off by {degrees}° and {offset}");
    let guided = upcr([
        "register",
        &sample("source.ply"),
        &sample("target.ply"),
        "--method",
        "prior",
        "--init",
        &pose,
        "--json",
    ]);
    assert_eq!(guided.status, 0, "{}", guided.stderr);
    assert_eq!(guided.json()["method"], "prior");
}

#[test]
fn locked_axes_keep_their_value() {
    let scratch = Scratch::new();
    let cloud = surface(40, 1.0);
    let target = scratch.xyz("target.xyz", &cloud);
    let moved: Vec<_> = cloud.iter().map(|p| [p[0] + 0.01, p[1] - 0.01, p[2] + 0.01]).collect();
    let source = scratch.xyz("source.xyz", &moved);
    let run = upcr([
        "register",
        &source,
        &target,
        "--method",
        "prior",
        "--lock",
        "roll,pitch,yaw",
        "--lock",
        "z",
        "--json",
    ]);
    let answer = run.json();
    let locks = &answer["settings"]["locks"];
    for (axis, locked) in
        [("roll", true), ("pitch", true), ("yaw", true), ("x", false), ("y", false), ("z", true)]
    {
        assert_eq!(locks[axis], locked, "{axis}");
    }
    let pose = matrix(&answer["T_target_source"]);
    assert_eq!([&pose[..3], &pose[4..7], &pose[8..12]].concat(), [1., 0., 0., 0., 1., 0., 0., 0., 1., 0.]);
}

#[test]
fn disjoint_clouds_are_not_registered() {
    let scratch = Scratch::new();
    let source = scratch.xyz("source.xyz", &surface(40, 1.0));
    let away: Vec<_> = surface(40, 1.0).iter().map(|p| [p[0] + 1000.0, p[1], p[2]]).collect();
    let target = scratch.xyz("target.xyz", &away);
    let pose = scratch.path("T.txt");
    let run = upcr(["register", &source, &target, "--method", "prior", "--json", "--transform", &pose]);
    assert_eq!(run.status, 3, "{}", run.stderr);
    let answer = run.json();
    assert_eq!(answer["converged"], false);
    assert_eq!(answer["num_inliers"], 0);
    assert!(answer["probability"].as_f64().unwrap() < 0.5);
    assert!(!answer["reasons"].as_array().unwrap().is_empty());
    // Written all the same, and said so.
    assert_eq!(numbers(&pose).len(), 16);
    assert!(run.stderr.contains("not trustworthy"), "{}", run.stderr);
}

/// A reader that hangs up before the answer comes once ended programs with a panic.
#[cfg(unix)]
#[test]
fn a_closed_pipe_is_no_panic() {
    use std::process::Stdio;
    let mut child = command()
        .args(["register", &sample("source.ply"), &sample("target.ply")])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0));
    assert_eq!(output.stderr, b"");
}

#[test]
fn a_list_of_pairs_is_answered_line_by_line() {
    let scratch = Scratch::new();
    let (source, target) = (sample("source.ply"), sample("target.ply"));
    let missing = scratch.path("nowhere.ply");
    let truth = sample("T_target_source.txt");
    let list = scratch.file(
        "pairs.txt",
        format!(
            "# source target guess\n{source}\t{target}\n\n{missing}\t{target}\n{source}\t{target}\t{truth}\n"
        ),
    );
    let run = upcr(["register", "--pairs", &list]);
    assert_eq!(run.status, 1, "one pair is unreadable: {}", run.stderr);
    let answers: Vec<Value> = run.stdout.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(answers.len(), 3);
    for found in [&answers[0], &answers[2]] {
        assert_eq!(found["source"], source.as_str());
        let (degrees, _) = pose_error(&matrix(&found["T_target_source"]), &numbers(&truth));
        assert!(degrees < 1.0, "off by {degrees}°");
    }
    let error = answers[1]["error"].as_str().unwrap();
    assert!(error.contains("nowhere.ply") && answers[1].get("T_target_source").is_none(), "{error}");

    let alone = upcr(["register", &source, &target, "--json"]).json();
    assert_eq!(answers[0]["T_target_source"], alone["T_target_source"], "alone or in a list: the same bits");

    let garbled = scratch.file("garbled.txt", "one two three four\n");
    upcr(["register", "--pairs", &garbled]).assert_fails(1, &["garbled.txt", "columns"]);
    assert_eq!(
        upcr(["register", &source, "--pairs", &list]).status,
        2,
        "a list and a source exclude each other"
    );
}

#[test]
fn equal_answers_without_times_are_equal_bytes() {
    let scratch = Scratch::new();
    let (source, target) = (sample("source.ply"), sample("target.ply"));
    let list =
        scratch.file("pairs.txt", format!("{source}\t{target}\n{source}\t{}\n", scratch.path("nowhere.ply")));
    for (call, status) in [(vec![&*source, &target, "--json"], 0), (vec!["--pairs", &list], 1)] {
        let run = |threads| {
            let run = upcr([&["register"], &call[..], &["--no-times", "--threads", threads]].concat());
            assert_eq!(run.status, status, "{}", run.stderr);
            run.stdout
        };
        let (one, two) = (run("1"), run("2"));
        assert_eq!(one, two);
        for (word, is_there) in
            [("timings_ms", false), ("threads", false), ("probability", true), ("max_seconds", true)]
        {
            assert_eq!(one.contains(&format!("\"{word}\"")), is_there, "{word} in {one}");
        }
    }
    assert_eq!(upcr(["register", &source, &target, "--no-times"]).status, 2, "a summary has its times");
}

#[test]
fn no_time_is_no_pose_but_an_answer() {
    let (source, target) = (sample("source.ply"), sample("target.ply"));
    let run = upcr(["register", &source, &target, "--max-seconds", "0", "--json"]);
    assert_eq!(run.status, 3, "{}", run.stderr);
    let answer = run.json();
    assert_eq!(answer["reasons"], serde_json::json!(["time_limit"]));
    assert_eq!((&answer["probability"], &answer["converged"]), (&0.0.into(), &false.into()));
    assert_eq!(answer["settings"]["max_seconds"], 0.0);
    let run = upcr(["register", &source, &target, "--max-seconds", "0"]);
    assert!(run.stdout.contains("the time limit ended the search early"), "{}", run.stdout);
    let ample = upcr(["register", &source, &target, "--max-seconds", "1e6", "--json"]);
    assert_eq!((ample.status, &ample.json()["reasons"]), (0, &serde_json::json!([])));
    upcr(["register", &source, &target, "--max-seconds", "-1"]).assert_fails(1, &["max_seconds", "-1"]);
}

#[test]
fn memory_is_bounded_in_any_unit() {
    let scratch = Scratch::new();
    let (source, target) = (sample("source.ply"), sample("target.ply"));
    for (told, bytes) in [("16777216", 16 << 20), ("16384k", 16 << 20), ("16M", 16 << 20), ("1G", 1 << 30)] {
        let run = upcr(["register", &source, &target, "--max-memory", told, "--json"]);
        assert_eq!(run.status, 0, "{}", run.stderr);
        assert_eq!(run.json()["settings"]["max_memory_bytes"], bytes);
    }
    // Cells as small as the points' distances do not fit: half of the points do.
    let cloud = scratch.xyz("cloud.xyz", &surface(150, 1.0));
    let fine = ["register", &cloud, &cloud, "--voxel-size", "0.005"];
    let used = |run: crate::Run| run.json()["points_used"].clone();
    assert_eq!(used(upcr([&fine[..], &["--json"]].concat())), serde_json::json!([22500, 22500]));
    let run = upcr([&fine[..], &["--json", "--max-memory", "20M"]].concat());
    assert_eq!(used(run), serde_json::json!([11250, 11250]));
    let run = upcr([&fine[..], &["--max-memory", "20M"]].concat());
    assert!(run.stdout.contains("11250 of the source"), "{}", run.stdout);

    let run = upcr(["register", &source, &target, "--max-memory", "1M"]);
    run.assert_fails(1, &["at least", "1048576"]);
    for wrong in ["lots", "-1", "2 G", "M", "1.5G", "99999999T"] {
        assert_eq!(
            upcr(["register", &source, &target, &format!("--max-memory={wrong}")]).status,
            2,
            "{wrong}"
        );
    }
}

#[test]
fn outputs_that_cannot_be_written_are_refused_before_the_work() {
    let scratch = Scratch::new();
    let (source, target) = (sample("source.ply"), sample("target.ply"));
    for (option, path, word) in [
        ("-o", scratch.path("aligned.unknown"), "known format"),
        ("-o", scratch.path("aligned.off"), "not written"),
        ("-o", scratch.path("nowhere/aligned.ply"), "no folder"),
        ("--transform", scratch.path("nowhere/T.txt"), "no folder"),
    ] {
        upcr(["register", &source, &target, option, &path]).assert_fails(1, &[word]);
    }
}

#[test]
fn the_report_holds_the_answer_and_asks_for_nothing_else() {
    let scratch = Scratch::new();
    let report = scratch.path("out.html");
    let (source, target) = (sample("source.ply"), sample("target.ply"));
    let run = upcr(["register", &source, &target, "--json", "--report", &report]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    let page = std::fs::read_to_string(&report).unwrap();
    let data = page.split_once("id=\"page\">").unwrap().1.split_once("</script>").unwrap().0;
    let told: Value = serde_json::from_str(data).unwrap();
    assert_eq!(told["registration"], run.json());
    assert_eq!(told["clouds"][0]["points"], 8308);
    assert!(page.contains("default-src 'none'"));
    assert_eq!(scratch.names(), ["out.html"]);

    let nowhere = scratch.path("none/out.html");
    upcr(["register", &source, &target, "--report", &nowhere]).assert_fails(1, &["there is no folder"]);
}
