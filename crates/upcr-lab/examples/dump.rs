//! Dump.
use rayon::prelude::*;
use std::{io::Write, path::Path};
use upcr::*;
use upcr_lab::{
    data::{self, Split, seven_scenes},
    trust::cases::*,
};
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let data = Path::new("/work/shared/data");
    let (name, count, seed): (&str, u64, u64) = (&a[1], a[2].parse().unwrap(), a[3].parse().unwrap());
    let material = match name {
        "train" => Material::Shapes(data::open(data.join("shapes69"), Split::Train).unwrap()),
        "test" => Material::Shapes(data::open(data.join("shapes69"), Split::Test).unwrap()),
        "virtual" => {
            let t = std::time::Instant::now();
            let m = Material::virtual_scenes(seed, 160).unwrap();
            eprintln!("scenes {:.1} s", t.elapsed().as_secs_f64());
            m
        }
        "kitchen" => Material::Frames(seven_scenes::frames(&data.join("redkitchen"), Split::All).unwrap().0),
        "bunny" => Material::posed_scans(&data.join("stanford_bunny"), None).unwrap(),
        _ => panic!(),
    };
    let out = std::sync::Mutex::new(std::io::BufWriter::new(std::fs::File::create(&a[4]).unwrap()));
    let start = std::time::Instant::now();
    (0..count).into_par_iter().for_each(|i| {
        let case = match material.case(seed, i) { Ok(c) => c, Err(e) => { eprintln!("{i}: {e}"); return } };
        let mut settings = Settings::default();
        if i % 8 == 7 { settings.method = Method::Features; }
        let found = match register(&case.source, &case.target, &settings) { Ok(f) => f, Err(e) => { eprintln!("{i}: {e}"); return } };
        let right = case.is_right(&found.T_target_source);
        let rot = case.T_target_source.map(|t| upcr_lab::eval::metrics::rotation_error_deg(&found.T_target_source, &t));
        let line = serde_json::json!({"i": i, "kind": case.kind, "right": right, "p": found.probability, "method": found.method, "e": found.evidence, "ms": found.timings_ms.total, "verify": found.timings_ms.verify, "n": [case.source.len(), case.target.len()], "rot": rot, "reasons": found.reasons, "alt": found.alternatives.len(), "voxel": found.voxel_size});
        writeln!(out.lock().unwrap(), "{line}").unwrap();
    });
    eprintln!("{:.1} s", start.elapsed().as_secs_f64());
}
