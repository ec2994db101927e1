//! The commands beside `register`.

use crate::{Scratch, numbers, pose_error, sample, surface, upcr};

#[test]
fn info_says_what_a_file_holds() {
    let scratch = Scratch::new();
    let file = scratch.xyz("cloud.xyz", &surface(10, 2.0));
    let run = upcr(["info", &file, "--json"]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    let answer = run.json();
    assert_eq!(answer["points"], 100);
    assert_eq!(answer["non_finite"], 0);
    assert_eq!(answer["normals"], false);
    assert_eq!(answer["min"][0], 0.0);
    assert_eq!(answer["extent"][1], 2.0);
    let lines = upcr(["info", &file]).stdout;
    assert!(lines.contains("points      100\n"), "{lines}");
}

#[test]
fn info_tells_comments_and_leaves_the_terminal_alone() {
    let scratch = Scratch::new();
    let ply = "ply\nformat ascii 1.0\ncomment \u{1b}[31mred\nelement vertex 1\nproperty float x\nproperty float y\n\
               property float z\nend_header\n1 2 3\n";
    let file = scratch.file("a.ply", ply);
    assert_eq!(upcr(["info", &file, "--json"]).json()["comments"][0], "\u{1b}[31mred");
    let lines = upcr(["info", &file]).stdout;
    assert!(lines.contains("comment     \u{fffd}[31mred\n"), "{lines}");
}

#[test]
fn convert_keeps_the_points() {
    let scratch = Scratch::new();
    let points = surface(10, 2.0);
    let xyz = scratch.xyz("cloud.xyz", &points);
    for (name, option) in
        [("a.ply", None), ("b.ply", Some("--ascii")), ("c.pcd", None), ("d.pcd", Some("--compressed"))]
    {
        let there = scratch.path(name);
        let run = upcr(["convert", &xyz, &there].into_iter().chain(option));
        assert_eq!((run.status, run.stdout.as_str()), (0, ""), "{}", run.stderr);
        let info = upcr(["info", &there, "--json"]).json();
        assert_eq!(info["points"], 100, "{name}");
        assert!(
            (info["extent"][2].as_f64().unwrap()
                - upcr(["info", &xyz, "--json"]).json()["extent"][2].as_f64().unwrap())
            .abs()
                < 1e-5
        );
    }
    let text = std::fs::read(scratch.path("b.ply")).unwrap();
    assert!(text.starts_with(b"ply\nformat ascii"));
}

#[test]
fn convert_thins_and_moves() {
    let scratch = Scratch::new();
    let xyz = scratch.xyz("cloud.xyz", &surface(50, 1.0));
    let pose = scratch.file("T.txt", "1 0 0 10\n0 1 0 0\n0 0 1 0\n0 0 0 1\n");
    let there = scratch.path("thin.ply");
    let run = upcr(["convert", &xyz, &there, "--voxel-size", "0.1", "--transform", &pose]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    let info = upcr(["info", &there, "--json"]).json();
    let points = info["points"].as_u64().unwrap();
    assert!((100..2500).contains(&points), "{points} points");
    assert!(info["min"][0].as_f64().unwrap() >= 10.0);
}

#[test]
fn convert_changes_the_unit() {
    let scratch = Scratch::new();
    let metres = scratch.xyz("metres.xyz", &surface(20, 1.0));
    let millimetres = scratch.path("millimetres.pcd");
    let run = upcr(["convert", &metres, &millimetres, "--scale", "1000", "--viewpoint", "0,0,2"]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    let [before, after] = [&metres, &millimetres].map(|file| upcr(["info", file, "--json"]).json());
    for k in 0..3 {
        let [before, after] = [&before, &after].map(|info| info["max"][k].as_f64().unwrap());
        assert!((after / 1000.0 - before).abs() < 1e-6, "{before} {after}");
    }
    assert_eq!(after["viewpoint"], serde_json::json!([0.0, 0.0, 2000.0]));
    for factor in ["0", "-1", "inf", "big"] {
        assert_eq!(upcr(["convert", &metres, &millimetres, "--scale", factor]).status, 2);
    }
}

#[test]
fn features_are_one_row_a_point() {
    let scratch = Scratch::new();
    let cloud = scratch.xyz("cloud.xyz", &surface(20, 1.0));
    for kind in ["distance", "ppf", "spfh", "pfh", "fpfh"] {
        let npy = scratch.path(&format!("{kind}.npy"));
        let run = upcr(["features", &cloud, "--kind", kind, "-o", &npy, "--json"]);
        assert_eq!(run.status, 0, "{}", run.stderr);
        let answer = run.json();
        assert_eq!(answer["points"], 400);
        assert_eq!(answer["kind"], kind);
        let dim = answer["dim"].as_u64().unwrap();
        assert!(dim > 0);
        for key in ["neighbors", "normals", "feature", "total"] {
            assert!(answer["timings_ms"][key].is_f64(), "timings_ms.{key}");
        }
        let bytes = std::fs::read(&npy).unwrap();
        assert_eq!(&bytes[..6], b"\x93NUMPY");
        let header = String::from_utf8_lossy(&bytes[10..200.min(bytes.len())]).into_owned();
        assert!(header.contains(&format!("(400, {dim})")), "{header}");
        assert_eq!(bytes.len() % 64, (400 * dim as usize * 4) % 64);
    }
}

#[test]
fn features_refuse_what_has_none() {
    let scratch = Scratch::new();
    let one = scratch.xyz("one.xyz", &[[0.0; 3]]);
    let npy = scratch.path("out.npy");
    upcr(["features", &one, "--kind", "fpfh", "-o", &npy]).assert_fails(1, &["one.xyz"]);
    for (option, value) in [("-k", "0"), ("--radius", "-1"), ("--radius", "nan")] {
        let run = upcr(["features", &sample("source.ply"), "--kind", "fpfh", "-o", &npy, option, value]);
        run.assert_fails(1, &["setting"]);
    }
    assert_eq!(scratch.names(), ["one.xyz"]);
}

#[test]
fn synth_writes_scans_that_register_to_their_poses() {
    let scratch = Scratch::new();
    let (once, twice) = (scratch.path("once"), scratch.path("twice"));
    for out in [&once, &twice] {
        let run = upcr(["synth", "--scene", "object", "--seed", "3", "--out", out]);
        assert_eq!(run.status, 0, "{}", run.stderr);
        assert_eq!(run.stdout.lines().count(), 2, "{}", run.stdout);
        for name in ["scan_000.ply", "scan_001.ply"] {
            assert!(
                upcr(["info", &format!("{out}/{name}"), "--json"]).json()["points"].as_u64() > Some(1000)
            );
        }
        assert_eq!(numbers(format!("{out}/T_world_001.txt")).len(), 16);
    }
    // The same seed, the same bytes.
    for entry in std::fs::read_dir(&once).unwrap() {
        let path = entry.unwrap().path();
        let twin = std::path::Path::new(&twice).join(path.file_name().unwrap());
        assert_eq!(std::fs::read(&path).unwrap(), std::fs::read(twin).unwrap(), "{}", path.display());
    }
    // From the true pose, the registration stays there.
    let [source, target, truth] =
        ["scan_001.ply", "scan_000.ply", "T_000_001.txt"].map(|n| format!("{once}/{n}"));
    let found = scratch.path("T.txt");
    let run = upcr([
        "register",
        &source,
        &target,
        "--method",
        "prior",
        "--init",
        &truth,
        "--transform",
        &found,
        "--json",
    ]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    let (degrees, offset) = pose_error(&numbers(&found), &numbers(&truth));
    let voxel = run.json()["voxel_size"].as_f64().unwrap();
    assert!(degrees < 1.0 && offset < 2.0 * voxel, "off by {degrees}° and {offset}");
}

/// The samples are what the command in their README makes.
#[test]
fn synth_makes_the_samples() {
    let scratch = Scratch::new();
    let readme = std::fs::read_to_string(sample("README.md")).unwrap();
    let command =
        readme.lines().find_map(|line| line.strip_prefix("upcr ")).expect("the README has the command");
    let out = scratch.path("scans");
    let words = command.split_whitespace().map(|word| if word == "scans" { &out } else { word });
    let run = upcr(words);
    assert_eq!(run.status, 0, "{}", run.stderr);
    for (made, kept) in [("scan_001.ply", "source.ply"), ("scan_000.ply", "target.ply")] {
        let [made, kept] =
            [format!("{out}/{made}"), sample(kept)].map(|f| upcr(["info", &f, "--json"]).json());
        assert_eq!(made["points"], kept["points"]);
        for key in ["min", "max"] {
            for axis in 0..3 {
                let [a, b] = [&made, &kept].map(|info| info[key][axis].as_f64().unwrap());
                assert!((a - b).abs() < 1e-9, "{key}: {a} {b}");
            }
        }
    }
    let [made, kept] = [format!("{out}/T_000_001.txt"), sample("T_target_source.txt")].map(numbers);
    assert!(made.iter().zip(&kept).all(|(a, b)| (a - b).abs() < 1e-9), "{made:?} {kept:?}");
}

#[test]
fn synth_scans_with_the_sensor_that_is_asked_for() {
    let scratch = Scratch::new();
    let points = |options: &str| {
        let out = scratch.path("scans");
        let run =
            upcr(["synth", "--scans", "1", "--out", &out].into_iter().chain(options.split_whitespace()));
        assert_eq!(run.status, 0, "{}", run.stderr);
        upcr(["info", &format!("{out}/scan_000.ply"), "--json"]).json()["points"].as_u64().unwrap()
    };
    let whole = points("--scene room --size 160x120 --noise 0");
    assert!((10_000..=160 * 120).contains(&whole), "{whole} points");
    let half = points("--scene room --size 160x120 --noise 0 --dropout 0.5");
    assert!((half as f64 / whole as f64 - 0.5).abs() < 0.05, "{half} of {whole} points");
    let near = points("--scene room --size 160x120 --noise 0 --range 0.3,2");
    assert!(near < whole, "{near} of {whole} points");
    let lidar = points("--scene room --sensor lidar --beams 16 --azimuth-steps 100 --noise 0");
    assert!((800..=1600).contains(&lidar), "{lidar} points");

    let out = scratch.path("none");
    for (options, word) in [
        ("--scene street --size 64x48", "--size"),
        ("--scene room --beams 16", "--beams"),
        ("--scene room --size 0x10", "sensor"),
        ("--scene room --dropout 1.5", "dropout"),
        ("--scene room --range 2,1", "range_m"),
        ("--scene room --noise -1", "noise"),
    ] {
        let run = upcr(["synth", "--out", &out].into_iter().chain(options.split_whitespace()));
        run.assert_fails(1, &[word]);
    }
    for option in ["--size=64", "--size=axb", "--range=1", "--range=a,b"] {
        upcr(["synth", "--out", &out, option]).assert_fails(2, &[&option[..6]]);
    }
    assert!(!std::path::Path::new(&out).exists());
}

#[test]
fn help_tells_the_exit_statuses() {
    let run = upcr(["--help"]);
    assert_eq!((run.status, run.stderr.as_str()), (0, ""));
    assert!(run.stdout.contains("Exit status"), "{}", run.stdout);
    for command in ["register", "features", "synth", "convert", "info"] {
        assert!(run.stdout.contains(command));
        assert_eq!(upcr([command, "--help"]).status, 0);
    }
    assert_eq!(upcr(["--version"]).stdout, concat!("upcr ", env!("CARGO_PKG_VERSION"), "\n"));
}

#[test]
fn convert_leaves_out_invalid_points_when_told_to() {
    let scratch = Scratch::new();
    let cloud = scratch.file("holes.xyz", "1 2 3\nnan 1 1\n4 5 6\n7 8 inf\n");
    let kept = scratch.path("kept.xyz");
    let run = upcr(["convert", &cloud, &kept, "--remove-invalid"]);
    assert_eq!(run.status, 0, "{}", run.stderr);
    let text = std::fs::read_to_string(&kept).unwrap();
    let rows = text.lines().filter(|line| line.starts_with(|c: char| c.is_ascii_digit())).count();
    assert_eq!(rows, 2, "{text}");
}

#[test]
fn convert_samples_and_removes_outliers() {
    let scratch = Scratch::new();
    let grid: Vec<[f64; 3]> =
        (0..400).map(|i| [f64::from(i % 20), f64::from(i / 20), 0.0]).chain([[1e6, 0.0, 500.0]]).collect();
    let cloud = scratch.xyz("grid.xyz", &grid);
    let points = |arguments: &[&str]| {
        let kept = scratch.path("kept.xyz");
        let run = upcr([&["convert", &cloud, &kept], arguments].concat());
        assert_eq!(run.status, 0, "{}", run.stderr);
        let answer = upcr(["info", &kept, "--json"]).json();
        (answer["points"].as_u64().unwrap(), answer["max"][0].as_f64().unwrap())
    };
    assert_eq!(points(&["--remove-outliers", "8,2"]), (400, 19.0));
    assert_eq!(points(&["--farthest", "5"]), (5, 1e6), "what stands apart is chosen early");
    assert_eq!(points(&["--random", "50", "--seed", "3"]).0, 50);
    assert_eq!(points(&["--random", "9999"]).0, 401);
    for wrong in ["8", "0,1", "8,-1", "8,nan"] {
        let run = upcr(["convert", &cloud, &scratch.path("none.xyz"), "--remove-outliers", wrong]);
        assert_eq!(run.status, 2, "{wrong}");
    }
}

#[test]
fn view_writes_a_page_of_the_clouds() {
    let scratch = Scratch::new();
    let (a, b) = (scratch.xyz("a<b>.xyz", &surface(10, 2.0)), scratch.xyz("b.xyz", &surface(12, 2.0)));
    let pose = scratch.file("T.txt", "1 0 0 10\n0 1 0 0\n0 0 1 0\n0 0 0 1\n");
    let page = scratch.path("page.html");
    let run = upcr(["view", &a, &b, &b, "--pose", &pose, "--out", &page, "--no-open"]);
    assert_eq!((run.status, run.stdout), (0, format!("{page}\n")), "{}", run.stderr);
    let html = std::fs::read_to_string(&page).unwrap();
    assert!(
        html.starts_with("<!doctype html>")
            && html.contains("a\\u003cb\\u003e.xyz")
            && !html.contains("a<b>")
    );

    let empty = scratch.xyz("empty.xyz", &[[f64::NAN; 3]]);
    upcr(["view", &a, &empty, "--no-open"]).assert_fails(1, &["empty.xyz", "no point"]);
}
