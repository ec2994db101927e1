//! `--rerun`: what reaches the viewer, read back from a file.

#[cfg(not(feature = "rerun"))]
#[test]
fn rerun_without_the_feature_says_how_to_get_it() {
    use crate::{sample, upcr};

    for args in [
        &["register", &sample("source.ply"), &sample("target.ply"), "--rerun"][..],
        &["view", "a.ply", "--rerun=a.rrd"],
    ] {
        upcr(args).assert_fails(2, &["--rerun", "without the feature `rerun`", "--features rerun"]);
    }
    assert!(!upcr(["register", "--help"]).stdout.contains("--rerun"));
}

#[cfg(feature = "rerun")]
mod with_the_feature {
    use std::collections::BTreeMap;
    use std::fs::File;
    use std::io::{self, BufReader};
    use std::net::{TcpListener, TcpStream};
    use std::time::{Duration, Instant};

    use re_sdk::external::re_log_encoding::DecoderApp;
    use re_sdk::log::{Chunk, LogMsg};
    use re_sdk::{ComponentIdentifier, TimelineName};
    use re_sdk_types::archetypes::{Points3D, Scalars, TextDocument, Transform3D};

    use crate::{Scratch, command, numbers, sample, upcr};

    /// What a recording holds, by entity; times are those of the one timeline, `None` for what is static.
    #[derive(Default)]
    struct Recording(BTreeMap<String, Vec<Chunk>>);

    impl Recording {
        fn read(path: &str) -> Self {
            let mut recording = Self::default();
            for message in DecoderApp::decode_lazy(BufReader::new(File::open(path).unwrap())) {
                // The layout is a store of its own.
                if let LogMsg::ArrowMsg(store, message) = message.unwrap()
                    && store.is_recording()
                {
                    let chunk = Chunk::from_arrow_msg(&message).unwrap();
                    recording.0.entry(chunk.entity_path().to_string()).or_default().push(chunk);
                }
            }
            recording
        }

        fn chunks(&self, entity: &str) -> &[Chunk] {
            self.0.get(entity).unwrap_or_else(|| panic!("{entity} is none of {:?}", self.0.keys()))
        }

        fn times(&self, entity: &str, timeline: &str, component: ComponentIdentifier) -> Vec<i64> {
            let times = self.chunks(entity).iter().flat_map(|chunk| {
                assert!(chunk.timelines().keys().all(|name| name.as_str() == timeline), "{entity}");
                chunk
                    .iter_component_indices(TimelineName::try_new(timeline).unwrap(), component)
                    .map(|(time, _)| time.as_i64())
            });
            times.collect()
        }

        fn scalars(&self, entity: &str) -> Vec<f64> {
            let component = Scalars::descriptor_scalars().component;
            let values = self.chunks(entity).iter().flat_map(|chunk| chunk.iter_slices::<f64>(component));
            values.flatten().copied().collect()
        }

        /// Row-major 4x4 matrices.
        fn poses(&self, entity: &str) -> Vec<[f64; 16]> {
            let matrices = Transform3D::descriptor_mat3x3().component;
            let translations = Transform3D::descriptor_translation().component;
            let mut poses = Vec::new();
            for chunk in self.chunks(entity) {
                let matrices = chunk.iter_slices::<[f32; 9]>(matrices);
                for (m, t) in matrices.zip(chunk.iter_slices::<[f32; 3]>(translations)) {
                    let (m, t) = (m[0].map(f64::from), t[0].map(f64::from));
                    poses.push([
                        m[0], m[3], m[6], t[0], m[1], m[4], m[7], t[1], m[2], m[5], m[8], t[2], 0.0, 0.0,
                        0.0, 1.0,
                    ]);
                }
            }
            poses
        }

        fn points(&self, entity: &str) -> Vec<[f32; 3]> {
            let component = Points3D::descriptor_positions().component;
            let points =
                self.chunks(entity).iter().flat_map(|chunk| chunk.iter_slices::<[f32; 3]>(component));
            points.flatten().copied().collect()
        }

        fn document(&self, entity: &str) -> String {
            let component = TextDocument::descriptor_text().component;
            let last = self.chunks(entity).iter().flat_map(|chunk| {
                chunk.iter_slices::<String>(component).map(|row| row[0].to_string()).collect::<Vec<_>>()
            });
            last.last().unwrap()
        }
    }

    fn pose(answer: &serde_json::Value) -> Vec<f64> {
        let rows = answer["T_target_source"].as_array().unwrap().iter();
        rows.flat_map(|row| row.as_array().unwrap()).map(|v| v.as_f64().unwrap()).collect()
    }

    fn largest_difference(a: &[f64], b: &[f64]) -> f64 {
        assert_eq!(a.len(), b.len());
        a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }

    #[test]
    fn rerun_file_has_the_steps_in_which_scans_come_together() {
        let scratch = Scratch::new();
        let [folder, model, file] = ["scans", "model.ply", "out.rrd"].map(|name| scratch.path(name));
        let made = upcr([
            "synth", "--scene", "object", "--scans", "5", "--size", "120x90", "--seed", "4", "--out", &folder,
        ]);
        assert_eq!(made.status, 0, "{}", made.stderr);
        let run = upcr(["merge", &folder, "-o", &model, "--json", &format!("--rerun={file}")]);
        assert!([0, 3].contains(&run.status), "{}", run.stderr);
        let told = run.json();
        let recording = Recording::read(&file);
        let scans = told["models"][0].as_array().unwrap();
        assert!(scans.len() >= 3, "{told}");
        for scan in scans {
            let entity = format!("/clouds/{}", scan["name"].as_str().unwrap());
            assert!(recording.points(&entity).len() > 100);
            let poses = recording.poses(&entity);
            assert!(poses.len() > 3);
            let rows = scan["T_model_scan"].as_array().unwrap().iter();
            let expected: Vec<f64> =
                rows.flat_map(|row| row.as_array().unwrap()).map(|v| v.as_f64().unwrap()).collect();
            assert!(largest_difference(poses.last().unwrap(), &expected) < 1e-4);
        }
        assert!(recording.scalars("/pairs/probability").len() >= told["pairs"].as_array().unwrap().len());
        assert!(recording.document("/summary").contains("model.ply"));
    }

    #[test]
    fn rerun_file_has_the_clouds_and_a_pose_for_each_iteration() {
        let scratch = Scratch::new();
        let file = scratch.path("out.rrd");
        let (source, target) = (sample("source.ply"), sample("target.ply"));
        let plain = upcr(["register", &source, &target, "--json", "--no-times"]);
        let run = upcr(["register", &source, &target, "--json", "--no-times", &format!("--rerun={file}")]);
        assert_eq!((run.status, &run.stderr[..]), (0, ""));
        assert_eq!(run.stdout, plain.stdout, "listening changes nothing");
        assert_eq!(scratch.names(), ["out.rrd"]);

        let recording = Recording::read(&file);
        assert_eq!(recording.points("/clouds/source").len(), 8308);
        assert!(recording.points("/clouds/target").len() > 8000);
        let poses = recording.poses("/clouds/source");
        let times =
            recording.times("/clouds/source", "iteration", Transform3D::descriptor_mat3x3().component);
        assert_eq!(times, (0..poses.len() as i64).collect::<Vec<_>>());
        assert_eq!(
            poses[0],
            [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        );
        let answer = run.json();
        assert!(largest_difference(poses.last().unwrap(), &pose(&answer)) < 1e-6);
        // The first guess and the answer, and between them for each hypothesis itself and its iterations.
        let [coarse, fine] = ["/rmse/coarse", "/rmse/fine"].map(|name| recording.scalars(name).len());
        let hypotheses = poses.len() - 2 - coarse - fine;
        assert_eq!(hypotheses, 1, "{coarse} and {fine} of {} poses", poses.len());
        assert_eq!(fine as u64, answer["iterations"].as_u64().unwrap());
        assert_eq!(recording.scalars("/verdict/probability"), [answer["probability"].as_f64().unwrap()]);
        assert!(recording.document("/summary").contains("registered: the pose is right"));
        assert!(!recording.0.contains_key("/notes"), "nothing is left out, and nothing is far");
    }

    #[test]
    fn rerun_far_clouds_lose_nothing() {
        let scratch = Scratch::new();
        let (file, moved) = (scratch.path("out.rrd"), scratch.path("far.ply"));
        let far = scratch.file("far.txt", "1 0 0 500000.25\n0 1 0 5400000.5\n0 0 1 300\n0 0 0 1\n");
        let run = upcr(["convert", &sample("target.ply"), &moved, "--transform", &far]);
        assert_eq!(run.status, 0, "{}", run.stderr);
        let run = upcr(["register", &sample("source.ply"), &moved, "--json", &format!("--rerun={file}")]);
        assert_eq!(run.status, 0, "{}", run.stderr);
        let recording = Recording::read(&file);
        assert!(recording.points("/clouds/target").iter().flatten().all(|v| v.abs() < 1.0));
        let notes = recording.document("/notes");
        assert!(notes.contains("target") && notes.contains("5400000"), "{notes}");
        let near = recording.poses("/clouds/source").pop().unwrap();
        let truth = numbers(sample("T_target_source.txt"));
        let (degrees, _) = crate::pose_error(&near, &truth);
        assert!(degrees < 1.0, "off by {degrees}°");
        // The source, moved as shown, lies among the target's points.
        let shown = recording.points("/clouds/source")[0].map(f64::from);
        let at: Vec<f64> = (0..3)
            .map(|r| (0..3).map(|c| near[4 * r + c] * shown[c]).sum::<f64>() + near[4 * r + 3])
            .collect();
        let there = recording.points("/clouds/target");
        let distance = |p: &[f32; 3]| (0..3).map(|k| (f64::from(p[k]) - at[k]).powi(2)).sum::<f64>().sqrt();
        assert!(there.iter().map(distance).fold(f64::INFINITY, f64::min) < 0.02);
    }

    #[test]
    fn rerun_view_shows_clouds_with_their_pose() {
        let scratch = Scratch::new();
        let file = scratch.path("view.rrd");
        let (source, target) = (sample("source.ply"), sample("target.ply"));
        let run = upcr([
            "view",
            &source,
            &target,
            "--pose",
            &sample("T_target_source.txt"),
            &format!("--rerun={file}"),
        ]);
        assert_eq!((run.status, &run.stdout[..], &run.stderr[..]), (0, "", ""));
        assert_eq!(scratch.names(), ["view.rrd"]);
        let recording = Recording::read(&file);
        let clouds: Vec<&String> = recording.0.keys().filter(|name| name.starts_with("/clouds/")).collect();
        assert_eq!(clouds.len(), 2);
        let moved = clouds.iter().find(|name| name.contains("source")).unwrap();
        let truth = numbers(sample("T_target_source.txt"));
        assert!(largest_difference(&recording.poses(moved)[0], &truth) < 1e-6);
        upcr(["view", &source, "--rerun=a.rrd", "--out", "a.html"]).assert_fails(2, &["--rerun", "--out"]);
    }

    #[cfg(feature = "train")]
    #[test]
    fn rerun_training_has_its_curves() {
        let scratch = Scratch::new();
        let (shapes, file) = (crate::learning::shapes(&scratch), scratch.path("run.rrd"));
        let settings = scratch.file("settings.toml", crate::learning::SETTINGS);
        let out = scratch.path("run");
        let args = ["train", "--data", &shapes, "--config", &settings, "--out", &out];
        let run = upcr(args.into_iter().chain([&format!("--rerun={file}")[..]]));
        assert_eq!(run.status, 0, "{}", run.stderr);
        let recording = Recording::read(&file);
        let steps = recording.times("/loss/held_out", "step", Scalars::descriptor_scalars().component);
        let history = std::fs::read_to_string(format!("{out}/history.csv")).unwrap();
        let expected: Vec<i64> =
            history.lines().skip(1).map(|line| line.split(',').next().unwrap().parse().unwrap()).collect();
        assert_eq!(steps, expected);
        assert!(recording.scalars("/loss/learned").iter().all(|loss| loss.is_finite()));
        assert!(!recording.scalars("/learning_rate/adam").is_empty());
    }

    #[test]
    fn rerun_to_nowhere_is_refused_before_the_work() {
        let scratch = Scratch::new();
        let (source, target) = (sample("source.ply"), sample("target.ply"));
        let missing = scratch.path("none/out.rrd");
        // The clouds are not even looked for.
        upcr(["register", "no.ply", "no.ply", &format!("--rerun={missing}")])
            .assert_fails(1, &["--rerun", "there is no folder"]);
        for (place, words) in [
            ("out.html", "neither a viewer's address"),
            ("rerun+http://a b/proxy", "rerun+http://a b/proxy"),
            ("rerun+http://127.0.0.1:1/entry/187b552b95a5c2f73f37894708825ba5", "rerun+http"),
        ] {
            upcr(["register", &source, &target, &format!("--rerun={place}")])
                .assert_fails(2, &["--rerun", words]);
        }
        let start = Instant::now();
        upcr(["register", "no.ply", "no.ply", "--rerun=rerun+http://127.0.0.1:1/proxy"])
            .assert_fails(1, &["--rerun", "no viewer answers at rerun+http://127.0.0.1:1/proxy"]);
        assert!(start.elapsed() < Duration::from_secs(20));
    }

    #[test]
    fn rerun_says_where_a_viewer_would_come_from() {
        if TcpStream::connect(("127.0.0.1", re_sdk::DEFAULT_SERVER_PORT)).is_ok() {
            println!("skipped: a viewer runs on this machine");
            return;
        }
        let scratch = Scratch::new();
        let run = || {
            let args = ["register", "no.ply", "no.ply", "--rerun"];
            let output = command().args(args).env("PATH", scratch.path("")).output().unwrap();
            (output.status.code(), String::from_utf8(output.stderr).unwrap())
        };
        let (status, words) = run();
        assert_eq!(status, Some(1));
        assert!(words.starts_with("error: --rerun: no viewer runs at 127.0.0.1:9876"), "{words}");
        assert!(words.contains("rerun-sdk=="), "{words}");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            let program = scratch.file("rerun", "#!/bin/sh\nexit 7\n");
            std::fs::set_permissions(program, std::fs::Permissions::from_mode(0o755)).unwrap();
            let (status, words) = run();
            assert!(status == Some(1) && words.contains("ended at once") && words.contains('7'), "{words}");
        }
    }

    #[test]
    fn rerun_leaves_no_file_of_a_registration_that_failed() {
        let scratch = Scratch::new();
        let few = scratch.xyz("few.xyz", &[[0.0; 3], [1.0; 3]]);
        let run = upcr(["register", &few, &few, &format!("--rerun={}", scratch.path("out.rrd"))]);
        run.assert_fails(1, &["few.xyz"]);
        assert_eq!(scratch.names(), ["few.xyz"]);
    }

    /// Something that takes what comes and says nothing is waited for, but not for ever, and costs the answer nothing.
    #[test]
    fn rerun_gives_up_on_a_viewer_that_says_nothing() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let place = format!("--rerun=rerun+http://{}/proxy", listener.local_addr().unwrap());
        std::thread::spawn(move || {
            for mut stream in listener.incoming().flatten() {
                std::thread::spawn(move || io::copy(&mut stream, &mut io::sink()));
            }
        });
        let start = Instant::now();
        let output = command()
            .args(["register", &sample("source.ply"), &sample("target.ply"), "--json", &place])
            .output()
            .unwrap();
        assert!(start.elapsed() < Duration::from_secs(60), "{:?}", start.elapsed());
        let stderr = String::from_utf8_lossy(&output.stderr);
        // Refused at once or given up at the end.
        assert!(stderr.contains("--rerun"), "{stderr}");
        if output.status.code() == Some(0) {
            assert!(stderr.starts_with("warning: ") && !output.stdout.is_empty(), "{stderr}");
        } else {
            assert!(stderr.contains("no viewer answers") && output.stdout.is_empty(), "{stderr}");
        }
    }
}
