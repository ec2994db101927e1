//! `upcr view`: clouds in 3-D, in the browser.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail};
use upcr::{PointCloud, Rigid, io};
use upcr_lab::files::write_atomically;
use upcr_report::Page;

use crate::output::{self, Progress};
use crate::stream::{Layout, Stream, Streaming};
use crate::{Status, input};

/// Show clouds in 3-D: writes one HTML page, which needs no network, and opens it in the browser
#[derive(clap::Args)]
pub struct Args {
    /// The clouds; distances are those of the first one's points to the second
    #[arg(required = true, value_name = "CLOUD")]
    clouds: Vec<PathBuf>,
    /// A pose that moves the first cloud: a text file with a 4x4 row-major matrix
    #[arg(long, value_name = "FILE")]
    pose: Option<PathBuf>,
    /// Where to write the page [default: a file in the folder for temporary ones]
    #[arg(long, value_name = "FILE", conflicts_with = "rerun")]
    out: Option<PathBuf>,
    /// Write the page, and open nothing
    #[arg(long, conflicts_with = "rerun")]
    no_open: bool,
    #[command(flatten)]
    stream: Streaming,
    #[command(flatten)]
    reading: input::Reading,
}

pub fn run(args: &Args) -> Result<Status> {
    if let Some(path) = &args.out {
        output::check_folder(path)?;
    }
    let pose = args.pose.as_deref().map(io::read_transform).transpose()?;
    let stream = args.stream.open("view", &Layout { clouds: true, curves: &[], words: false })?;
    let mut progress = Progress::new();
    let mut clouds: Vec<(String, PointCloud)> = Vec::new();
    let mut comments = Vec::new();
    let paths: Vec<&Path> = args.clouds.iter().map(PathBuf::as_path).collect();
    for (path, name) in paths.iter().zip(input::short_names(&paths)) {
        progress.step("reading");
        let cloud = args.reading.read(path)?;
        if cloud.finite().is_empty() {
            bail!("{}: there is no point with finite coordinates in it", path.display());
        }
        clouds.push((name, cloud));
        comments.push(io::read_comments(path)?);
    }
    if let Some(stream) = stream {
        show(stream, &clouds, pose.as_ref())?;
        return Ok(Status::Done);
    }
    progress.step("writing");
    let named: Vec<_> = clouds.iter().map(|(name, cloud)| (name.as_str(), cloud)).collect();
    let mut page = Page::of_clouds(&named).with_comments(&comments);
    if let Some(pose) = &pose {
        page = page.with_pose(pose);
    }
    let html = page.html()?;
    let path = match &args.out {
        Some(path) => path.clone(),
        None => temporary()?,
    };
    write_atomically(&path, html.as_bytes())?;
    drop(progress);

    output::answer(&format!("{}\n", path.display()))?;
    if !args.no_open && !open(&path) {
        output::note("warning: no browser could be started: open the page by hand, or say --no-open");
    }
    Ok(Status::Done)
}

/// Streams the clouds in place of a page.
fn show(mut stream: Stream, clouds: &[(String, PointCloud)], pose: Option<&Rigid>) -> Result<()> {
    let [(moved, source), others @ ..] = clouds else { return stream.close() };
    let mut others: Vec<_> =
        others.iter().enumerate().map(|(i, (name, cloud))| (name, cloud, i + 1)).collect();
    // The one that moves comes last, so that the picture's origin is near what stays.
    others.push((moved, source, 0));
    for (name, cloud, color) in others {
        stream.cloud(name, cloud, color);
        stream.pose(name, pose.filter(|_| color == 0).unwrap_or(&Rigid::identity()));
    }
    stream.close()
}

/// A page of one's own in a folder that only its maker can write to.
fn temporary() -> Result<PathBuf> {
    let parent = std::env::temp_dir();
    let process = std::process::id();
    let mut builder = std::fs::DirBuilder::new();
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    // Numbers of processes come back, and folders stay.
    for serial in 0..u32::MAX {
        let folder = parent.join(format!("upcr-view-{process}-{serial}"));
        match builder.create(&folder) {
            Ok(()) => return Ok(folder.join("view.html")),
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(error).with_context(|| folder.display().to_string()),
        }
    }
    bail!("{}: no name is left in it", parent.display())
}

/// Hands the page to the system's browser; whether one was there to take it.
fn open(path: &Path) -> bool {
    let mut command = if cfg!(target_os = "macos") {
        Command::new("open")
    } else if cfg!(windows) {
        // `start` is the shell's, and its first argument in quotes a title: Explorer takes the path as it is.
        Command::new("explorer")
    } else {
        Command::new("xdg-open")
    };
    let started = command.arg(path).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).status();
    // Explorer's status says nothing.
    started.is_ok_and(|status| status.success() || cfg!(windows))
}
