//! Draws the pictures of `upcr reproduce` and `upcr calibrate test` anew, from the `results.json` in their folders.
//!
//! `cargo run -p upcr-lab --example redraw -- docs/reproduction docs/trust`

use std::error::Error;
use std::path::{Path, PathBuf};

use upcr_lab::drawing::{Picture, png, svg};
use upcr_lab::experiments::{self, Results};
use upcr_lab::files::write_atomically;
use upcr_lab::trust::{self, Reliability};

fn main() -> Result<(), Box<dyn Error>> {
    for folder in std::env::args_os().skip(1).map(PathBuf::from) {
        let text = std::fs::read_to_string(folder.join("results.json"))?;
        let value: serde_json::Value = serde_json::from_str(&text)?;
        if let Some(found) = value.pointer("/trust/reliability") {
            let sets: Vec<(String, Reliability)> = serde_json::from_value(found.clone())?;
            let sets: Vec<_> = sets.iter().map(|(name, found)| (name.as_str(), found)).collect();
            draw(&folder, "reliability", &trust::picture(&sets))?;
        } else {
            let results: Results = serde_json::from_value(value)?;
            for outcome in &results.experiments {
                if let Some(picture) = experiments::picture(outcome) {
                    draw(&folder, &outcome.name, &picture)?;
                }
            }
        }
    }
    Ok(())
}

fn draw(folder: &Path, name: &str, picture: &impl Picture) -> upcr::Result<()> {
    write_atomically(&folder.join(format!("{name}.svg")), svg(picture).as_bytes())?;
    write_atomically(&folder.join(format!("{name}.png")), &png(picture)?)
}
