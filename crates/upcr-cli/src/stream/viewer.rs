//! The stream, by Rerun's SDK.
//!
//! A thread of its own holds the recording: whoever streams never waits for the viewer before the end, and then not for
//! ever.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddr, TcpStream};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::mpsc::{self, Receiver, Sender};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail};
use re_sdk::blueprint::{
    Blueprint, ContainerLike, Grid, Horizontal, Spatial3DView, Tabs, TextDocumentView, TextLogView,
    TimeSeriesView, Vertical,
};
use re_sdk::external::re_uri::ProxyUri;
use re_sdk::sink::{GrpcSink, GrpcSinkConnectionState, MemorySinkStorage};
use re_sdk::{EntityPath, RecordingStream, RecordingStreamBuilder, RecordingStreamResult, entity_path};
use re_sdk_types::archetypes::{Points3D, Scalars, TextDocument, TextLog, Transform3D};
use re_sdk_types::components::{Color, Radius, TextLogLevel};
use upcr::cloud::random_indices;
use upcr::{PointCloud, Rigid};
use upcr_lab::files::write_atomically;
use upcr_report::{CLOUD_COLORS, MOST_POINTS};

use super::{Layout, Where};
use crate::{describe, output};

/// Radius of a point on the screen.
const RADIUS: f32 = 1.5;
/// Coordinates larger than so many diagonals of their cloud get an origin of their own: single precision then resolves less
/// than a hundred-thousandth of the cloud.
const FAR: f64 = 64.0;
/// How long a viewer may take to answer, one that was just started to come up, and one to take what is left at the end.
const ANSWERING: Duration = Duration::from_secs(5);
const STARTING: Duration = Duration::from_secs(20);
const TAKING: Duration = Duration::from_secs(30);

type Log = Box<dyn FnOnce(&RecordingStream) -> RecordingStreamResult<()> + Send>;

enum Job {
    Log(Log),
    /// Nothing more comes; how it went is to be told.
    End(Sender<Result<()>>),
}

/// Clouds, poses of these over a timeline, figures and words, on their way to a viewer or a file.
pub struct Stream {
    jobs: Sender<Job>,
    is_live: bool,
    notes: String,
    /// Where each cloud's coordinates are counted from, in its own frame; that of the first is the picture's.
    origins: BTreeMap<String, [f64; 3]>,
    first: Option<[f64; 3]>,
}

impl Stream {
    pub(super) fn open(to: &Where, name: &str, layout: &Layout) -> Result<Self> {
        // What is asked for on the command line is not for the environment to forbid.
        let builder = RecordingStreamBuilder::new("upcr").recording_name(name).enabled(true);
        let builder = builder.with_default_blueprint(blueprint(layout));
        let (recording, file) = match to {
            Where::Here => (live(builder, &here()?)?, None),
            Where::Address(address) => (live(builder, address)?, None),
            Where::File(path) => {
                output::check_folder(path)?;
                let (recording, storage) = builder.memory()?;
                (recording, Some((path.clone(), storage)))
            }
        };
        recording.set_log_tick_enabled(false);
        recording.set_log_time_enabled(false);
        let is_live = file.is_none();
        let (jobs, todo) = mpsc::channel();
        thread::Builder::new().name("rerun".into()).spawn(move || work(&recording, file, &todo))?;
        Ok(Self { jobs, is_live, notes: String::new(), origins: BTreeMap::new(), first: None })
    }

    /// Shows a cloud under `clouds/`, in its own colours or the one of that number. The first should be one that stays.
    pub fn cloud(&mut self, name: &str, cloud: &PointCloud, color: usize) {
        let finite = |&i: &usize| cloud.points[i].iter().all(|v| v.is_finite());
        let mut chosen: Vec<usize> = (0..cloud.len()).filter(finite).collect();
        if chosen.len() > MOST_POINTS {
            let few = random_indices(chosen.len(), MOST_POINTS, 0);
            self.note(&format!("{name}: thinned for display to {MOST_POINTS} of {} points", chosen.len()));
            chosen = few.into_iter().map(|i| chosen[i]).collect();
        }
        let origin = origin(chosen.iter().map(|&i| cloud.points[i]));
        if origin != [0.0; 3] {
            let [x, y, z] = origin;
            self.note(&format!("{name}: its coordinates are counted from ({x}, {y}, {z})"));
        }
        if self.first.is_none() && origin != [0.0; 3] {
            self.note("the picture: its coordinates are counted from there");
        }
        self.origins.insert(name.into(), origin);
        self.first.get_or_insert(origin);
        let positions: Vec<[f32; 3]> = (chosen.iter())
            .map(|&i| std::array::from_fn(|k| (cloud.points[i][k] - origin[k]) as f32))
            .collect();
        let colors: Vec<Color> = match &cloud.colors {
            Some(own) => chosen.iter().map(|&i| own[i].into()).collect(),
            None => vec![CLOUD_COLORS[color % CLOUD_COLORS.len()].into()],
        };
        let points = Points3D::new(positions).with_colors(colors).with_radii([Radius::new_ui_points(RADIUS)]);
        let path = entity_path!("clouds", name);
        self.log(move |recording| recording.log_static(path, &points));
    }

    /// Goes on at that step of a timeline. What is streamed before the first step holds at all of them.
    pub fn at(&self, timeline: &'static str, step: u64) {
        self.log(move |recording| {
            recording.set_time_sequence(timeline, step as i64);
            Ok(())
        });
    }

    /// Moves a cloud: `T_picture_cloud` takes its coordinates to those of the first cloud.
    pub fn pose(&self, name: &str, T_picture_cloud: &Rigid) {
        let origin = |of: Option<&[f64; 3]>| Rigid::from_translation(of.copied().unwrap_or_default());
        // Both origins in double precision, so that what is left is as small as the clouds are.
        let T = origin(self.first.as_ref()).inverse() * *T_picture_cloud * origin(self.origins.get(name));
        let column = |c: usize| -> [f32; 3] { std::array::from_fn(|r| T.rotation[(r, c)] as f32) };
        let translation: [f32; 3] = std::array::from_fn(|k| T.translation[k] as f32);
        let transform = Transform3D::from_translation_mat3x3(translation, [column(0), column(1), column(2)]);
        let path = entity_path!("clouds", name);
        self.log(move |recording| recording.log(path, &transform));
    }

    /// A point of a curve, `DIAGRAM/CURVE`.
    pub fn number(&self, name: &str, value: f64) {
        let path = EntityPath::from(name);
        self.log(move |recording| recording.log(path, &Scalars::single(value)));
    }

    /// A line of the log.
    pub fn say(&self, line: &str) {
        let line = TextLog::new(line).with_level(TextLogLevel::INFO);
        self.log(move |recording| recording.log("log", &line));
    }

    /// Words to read, for all steps.
    pub fn document(&self, name: &str, words: &str) {
        // Code, so that columns stay columns.
        let (path, document) =
            (EntityPath::from(name), TextDocument::from_markdown(format!("```\n{words}\n```")));
        self.log(move |recording| recording.log_static(path, &document));
    }

    /// A line of the document that says how what is shown differs from the files.
    fn note(&mut self, line: &str) {
        self.notes.push_str(line);
        self.notes.push('\n');
        self.document("notes", &self.notes);
    }

    fn log(&self, log: impl FnOnce(&RecordingStream) -> RecordingStreamResult<()> + Send + 'static) {
        // A thread that has ended tells why when the stream is closed.
        let _ = self.jobs.send(Job::Log(Box::new(log)));
    }

    /// Writes the file; a viewer that does not take what is left is warned of.
    ///
    /// # Errors
    /// Where the file cannot be written.
    pub fn close(self) -> Result<()> {
        let (end, ended) = mpsc::channel();
        let _ = self.jobs.send(Job::End(end));
        if !self.is_live {
            return ended.recv().context("the recording's thread is gone")?;
        }
        let outcome = match ended.recv_timeout(TAKING) {
            Ok(outcome) => outcome,
            Err(_) => Err(anyhow!("the viewer did not take all in {} s", TAKING.as_secs())),
        };
        if let Err(error) = outcome {
            output::note(&format!("warning: --rerun: not all is shown: {}", describe(&error)));
        }
        Ok(())
    }
}

fn blueprint(layout: &Layout) -> Blueprint {
    let mut beside: Vec<ContainerLike> = Vec::new();
    for curves in layout.curves {
        beside.push(TimeSeriesView::new(*curves).with_origin(*curves).into());
    }
    if layout.words {
        let document = |name| TextDocumentView::new(name).with_origin(name).into();
        let log = TextLogView::new("log").with_origin("log").into();
        beside.push(Tabs::new([document("summary"), log, document("notes")]).into());
    }
    if !layout.clouds {
        return Blueprint::new(Grid::new(beside));
    }
    let clouds = Spatial3DView::new("clouds").with_origin("clouds").into();
    if beside.is_empty() {
        return Blueprint::new(Tabs::new([
            clouds,
            TextDocumentView::new("notes").with_origin("notes").into(),
        ]));
    }
    Blueprint::new(Horizontal::new([clouds, Vertical::new(beside).into()]).with_column_shares([2.0, 1.0]))
}

/// Logs what comes. A stream that is dropped and not closed leaves no file behind.
fn work(recording: &RecordingStream, file: Option<(PathBuf, MemorySinkStorage)>, jobs: &Receiver<Job>) {
    let mut outcome = Ok(());
    for job in jobs {
        match job {
            Job::Log(log) => outcome = outcome.and_then(|()| log(recording)),
            Job::End(end) => {
                let _ = end.send(outcome.map_err(Into::into).and_then(|()| finish(recording, file)));
                return;
            }
        }
    }
}

fn finish(recording: &RecordingStream, file: Option<(PathBuf, MemorySinkStorage)>) -> Result<()> {
    if let Some((path, storage)) = file {
        return Ok(write_atomically(&path, &storage.drain_as_bytes()?)?);
    }
    recording.flush_with_timeout(TAKING)?;
    // Waits until the viewer has confirmed.
    recording.disconnect();
    Ok(())
}

/// A recording to a viewer that has answered.
fn live(builder: RecordingStreamBuilder, address: &ProxyUri) -> Result<RecordingStream> {
    let sink = GrpcSink::new(address.clone());
    let start = Instant::now();
    while sink.status() != GrpcSinkConnectionState::Connected {
        let failed = matches!(sink.status(), GrpcSinkConnectionState::Disconnected(_));
        if failed || start.elapsed() > ANSWERING {
            bail!("no viewer answers at {address}");
        }
        thread::sleep(Duration::from_millis(10));
    }
    let recording = builder.buffered()?;
    recording.set_sink(Box::new(sink));
    Ok(recording)
}

/// The viewer on this machine, started where none runs.
fn here() -> Result<ProxyUri> {
    let address = SocketAddr::from((Ipv4Addr::LOCALHOST, re_sdk::DEFAULT_SERVER_PORT));
    let listens = || TcpStream::connect_timeout(&address, Duration::from_secs(1)).is_ok();
    let uri = re_sdk::DEFAULT_CONNECT_URL.parse()?;
    if listens() {
        return Ok(uri);
    }
    let mut command = Command::new("rerun");
    command
        .args([format!("--bind={}", address.ip()), format!("--port={}", address.port())])
        .args(["--hide-welcome-screen", "--expect-data-soon"])
        // What it says is no answer of ours, and whoever reads ours need not wait for it to end.
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    // Ctrl-C ends us, and the viewer stays.
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    let mut viewer = command.spawn().with_context(|| {
        let version = re_sdk::build_info().version;
        format!(
            "no viewer runs at {address}, and none can be started as `rerun` (one is installed by \
             `pip install rerun-sdk=={version}` or `cargo install rerun-cli@{version}`)"
        )
    })?;
    let start = Instant::now();
    while !listens() {
        if let Some(status) = viewer.try_wait()?.filter(|status| !status.success()) {
            bail!(
                "the viewer `rerun` ended at once, with {status}; where there is no display, start \
                 `rerun --serve-web` and say its address"
            );
        }
        if start.elapsed() > STARTING {
            bail!("the viewer `rerun` did not come up in {} s", STARTING.as_secs());
        }
        thread::sleep(Duration::from_millis(50));
    }
    Ok(uri)
}

/// Where the coordinates of points that lie far out are counted from: their middle, in round numbers; else zero.
fn origin(points: impl Iterator<Item = [f64; 3]>) -> [f64; 3] {
    let (mut min, mut max) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for p in points {
        for k in 0..3 {
            min[k] = min[k].min(p[k]);
            max[k] = max[k].max(p[k]);
        }
    }
    // Halves do not overflow.
    let half: [f64; 3] = std::array::from_fn(|k| 0.5 * max[k] - 0.5 * min[k]);
    let middle: [f64; 3] = std::array::from_fn(|k| 0.5 * max[k] + 0.5 * min[k]);
    let diagonal = 2.0 * half[0].hypot(half[1]).hypot(half[2]);
    let farthest = middle.iter().fold(0.0_f64, |far, v| far.max(v.abs()));
    if !diagonal.is_finite() || farthest <= FAR * diagonal {
        return [0.0; 3];
    }
    if diagonal == 0.0 {
        return middle;
    }
    let round = 10_f64.powf(diagonal.log10().floor());
    middle.map(|v| (v / round).round() * round)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn far_clouds_alone_have_an_origin_and_it_is_near_them() {
        let square = |at: [f64; 3], size: f64| origin([at, [at[0] + size, at[1] + size, at[2]]].into_iter());
        assert_eq!(square([3.0, -2.0, 10.0], 1.0), [0.0; 3]);
        assert_eq!(square([500_123.4, 5_400_567.8, 311.0], 50.0), [500_150.0, 5_400_590.0, 310.0]);
        assert_eq!(square([7.0, 8.0, 9.0], 0.0), [7.0, 8.0, 9.0]);
        assert_eq!(square([-1e308, -1e308, 0.0], 1.7e308), [0.0; 3]);
        assert_eq!(origin(std::iter::empty()), [0.0; 3]);
    }
}
