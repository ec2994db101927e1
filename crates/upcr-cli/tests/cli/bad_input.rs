//! Every bad input ends with its own sentence: no panic, nothing on stdout, no file left behind.

use crate::{Run, Scratch, sample, surface, upcr};

/// `path` as the source of a registration that would have written two files.
#[track_caller]
fn as_source(scratch: &Scratch, path: &str) -> Run {
    let before = scratch.names();
    let target = sample("target.ply");
    let (cloud, pose) = (scratch.path("aligned.ply"), scratch.path("T.txt"));
    let run = upcr(["register", path, &target, "--json", "-o", &cloud, "--transform", &pose]);
    assert_eq!(scratch.names(), before, "an error leaves no file");
    run
}

#[test]
fn a_missing_file() {
    let scratch = Scratch::new();
    as_source(&scratch, &scratch.path("nowhere.ply")).assert_fails(1, &["nowhere.ply", "No such file"]);
    let run = upcr(["register", &sample("source.ply"), &scratch.path("nowhere.pcd")]);
    run.assert_fails(1, &["nowhere.pcd"]);
}

#[test]
fn an_empty_file() {
    let scratch = Scratch::new();
    for name in ["empty.ply", "empty.pcd", "empty.xyz", "empty.las", "empty.npy", "empty.bin", "empty.off"] {
        as_source(&scratch, &scratch.file(name, "")).assert_fails(1, &[name, "empty"]);
    }
}

#[test]
fn a_truncated_file() {
    let scratch = Scratch::new();
    let whole = std::fs::read(sample("source.ply")).unwrap();
    for keep in [3, 40, whole.len() / 2, whole.len() - 1] {
        let name = format!("first{keep}.ply");
        as_source(&scratch, &scratch.file(&name, &whole[..keep])).assert_fails(1, &[&name]);
    }
}

#[test]
fn a_file_of_another_format() {
    let scratch = Scratch::new();
    as_source(&scratch, &scratch.file("text.ply", "these are words\n")).assert_fails(1, &["text.ply"]);
    as_source(&scratch, &scratch.file("text.xyz", "these are words\n")).assert_fails(1, &["text.xyz"]);
    let ply = std::fs::read(sample("source.ply")).unwrap();
    as_source(&scratch, &scratch.file("ply.pcd", ply)).assert_fails(1, &["ply.pcd"]);
    as_source(&scratch, &scratch.file("cloud.docx", "PK")).assert_fails(1, &["cloud.docx"]);
    as_source(&scratch, &scratch.file("cloud", "0 0 0\n")).assert_fails(1, &["cloud"]);
}

#[test]
fn a_folder() {
    let scratch = Scratch::new();
    std::fs::create_dir(scratch.path("folder.ply")).unwrap();
    as_source(&scratch, &scratch.path("folder.ply")).assert_fails(1, &["folder.ply"]);
}

/// The header's word is no reason to ask the system for memory.
#[test]
fn a_header_that_claims_more_than_the_file_holds() {
    let scratch = Scratch::new();
    let claim = 180_000_000; // times three floats: 2 GB
    let ply = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {claim}\n\
         property float x\nproperty float y\nproperty float z\nend_header\n0123456789ab"
    );
    as_source(&scratch, &scratch.file("claim.ply", ply)).assert_fails(1, &["claim.ply"]);
    let pcd = format!(
        "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {claim}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n\
         POINTS {claim}\nDATA binary\n0123456789ab"
    );
    as_source(&scratch, &scratch.file("claim.pcd", pcd)).assert_fails(1, &["claim.pcd"]);
}

#[test]
fn too_few_points() {
    let scratch = Scratch::new();
    let one = scratch.xyz("one.xyz", &[[1.0, 2.0, 3.0]]);
    as_source(&scratch, &one).assert_fails(1, &["one.xyz", "points"]);
    let run = upcr(["register", &sample("source.ply"), &one]);
    run.assert_fails(1, &["one.xyz", "target has too few points: 1"]);
}

#[test]
fn points_that_span_no_surface() {
    let scratch = Scratch::new();
    let line: Vec<_> = (0..1000).map(|i| [f64::from(i), 2.0 * f64::from(i), 1.0]).collect();
    as_source(&scratch, &scratch.xyz("line.xyz", &line)).assert_fails(1, &["line.xyz", "degenerate"]);
    let same = vec![[1.0, 2.0, 3.0]; 1000];
    as_source(&scratch, &scratch.xyz("same.xyz", &same)).assert_fails(1, &["same.xyz", "degenerate"]);
}

#[test]
fn points_that_are_not_finite() {
    let scratch = Scratch::new();
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let mut points = surface(30, 1.0);
        points[5][1] = bad;
        let mut bytes = Vec::new();
        for p in &points {
            bytes.extend(p.iter().chain([&0.0]).flat_map(|&v| (v as f32).to_le_bytes()));
        }
        as_source(&scratch, &scratch.file("bad.bin", bytes)).assert_fails(1, &["bad.bin", "index 5"]);
    }
}

#[test]
fn settings_out_of_range() {
    let (source, target) = (sample("source.ply"), sample("target.ply"));
    for size in ["0", "-1", "nan", "inf", "1e-300"] {
        upcr(["register", &source, &target, "--voxel-size", size]).assert_fails(1, &["voxel_size"]);
    }
    for share in ["0", "-0.5", "1.5", "nan"] {
        upcr(["register", &source, &target, "--overlap", share]).assert_fails(1, &["overlap"]);
    }
}

#[test]
fn a_first_guess_that_is_no_pose() {
    let scratch = Scratch::new();
    let (source, target) = (sample("source.ply"), sample("target.ply"));
    for (name, text) in [
        ("empty.txt", ""),
        ("words.txt", "one two three"),
        ("short.txt", "1 0 0 0\n0 1 0 0\n"),
        ("long.txt", &"1 0 0 0 0\n".repeat(4)),
        ("scale.txt", "2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n"),
        ("mirror.txt", "-1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"),
        ("nan.txt", "1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"),
    ] {
        let guess = scratch.file(name, text);
        upcr(["register", &source, &target, "--init", &guess]).assert_fails(1, &[name]);
    }
    upcr(["register", &source, &target, "--init", &scratch.path("nowhere.txt")])
        .assert_fails(1, &["nowhere.txt"]);
}

#[test]
fn a_command_line_that_is_not_understood() {
    let (source, target) = (sample("source.ply"), sample("target.ply"));
    for lock in
        ["", ",", "roll,", "up", "roll;yaw", "roll yaw", "x,x,w", "-x", "\u{1f512}", &"z,".repeat(10_000)]
    {
        upcr(["register", &source, &target, &format!("--lock={lock}")]).assert_fails(2, &["--lock"]);
    }
    for (option, value) in [
        ("--method", "magic"),
        ("--refine", "icp"),
        ("--kernel", "square"),
        ("--seed", "-1"),
        ("--threads", "0"),
        ("--voxel-size", "x"),
        ("--overlap", "half"),
    ] {
        upcr(["register", &source, &target, &format!("{option}={value}")]).assert_fails(2, &[option]);
    }
    upcr(["register", &source]).assert_fails(2, &["TARGET"]);
    upcr(["registre"]).assert_fails(2, &["registre"]);
}

#[test]
fn an_output_that_cannot_be_written() {
    let scratch = Scratch::new();
    let (source, target) = (sample("source.ply"), sample("target.ply"));
    let lost = scratch.path("no/such/folder/aligned.ply");
    upcr(["register", &source, &target, "-o", &lost]).assert_fails(1, &["aligned.ply"]);
    let unknown = scratch.path("aligned.docx");
    upcr(["register", &source, &target, "-o", &unknown]).assert_fails(1, &["aligned.docx"]);
    assert!(scratch.names().is_empty());
    // What was there stays whole until its successor is.
    let folder = scratch.path("taken.ply");
    std::fs::create_dir(&folder).unwrap();
    upcr(["register", &source, &target, "-o", &folder]).assert_fails(1, &["taken.ply"]);
    assert_eq!(scratch.names(), ["taken.ply"]);
}
