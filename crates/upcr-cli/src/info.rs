//! `upcr info`: what a file holds.

use std::fmt::Write;
use std::path::PathBuf;

use anyhow::Result;
use serde::Serialize;
use upcr::cloud::Summary;
use upcr::io;

use crate::Status;
use crate::{input, output};

/// Say what a file holds
#[derive(clap::Args)]
pub struct Args {
    /// The cloud, mesh or depth image to read
    file: PathBuf,
    /// Print one JSON object instead of lines
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    reading: input::Reading,
}

#[derive(Serialize)]
struct Told {
    #[serde(flatten)]
    summary: Summary,
    comments: Vec<String>,
}

pub fn run(args: &Args) -> Result<Status> {
    let summary = args.reading.read(&args.file)?.summary();
    let told = Told { summary, comments: io::read_comments(&args.file)? };
    if args.json {
        output::answer_json(&told)?;
    } else {
        output::answer(&lines(&told))?;
    }
    Ok(Status::Done)
}

fn lines(Told { summary, comments }: &Told) -> String {
    let triple = |v: [f64; 3]| format!("({:.6}, {:.6}, {:.6})", v[0], v[1], v[2]);
    let yes = |has: bool| if has { "yes" } else { "no" };
    let mut text = format!("points      {}\n", summary.points);
    if summary.non_finite > 0 {
        let _ = writeln!(text, "not finite  {}", summary.non_finite);
    }
    for (name, value) in [
        ("minimum", summary.min),
        ("maximum", summary.max),
        ("extent", summary.extent),
        ("centroid", summary.centroid),
        ("viewpoint", summary.viewpoint),
    ] {
        if let Some(value) = value {
            let _ = writeln!(text, "{name:<10}  {}", triple(value));
        }
    }
    let _ = writeln!(text, "normals     {}\ncolours     {}", yes(summary.normals), yes(summary.colors));
    for comment in comments {
        // What controls a terminal does not get to one.
        let _ = writeln!(text, "comment     {}", comment.replace(char::is_control, "\u{fffd}"));
    }
    text
}
