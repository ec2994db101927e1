//! Where words go: the answer to stdout, everything else to stderr. A reader that hangs up ends nothing.

use std::io::{self, IsTerminal, Write};
use std::path::Path;

use anyhow::bail;
use serde::Serialize;

/// Prints the answer. A closed pipe is no error: whoever closed it has read enough.
pub fn answer(text: &str) -> anyhow::Result<()> {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(anyhow::Error::new(error).context("stdout"))
        }
        _ => Ok(()),
    }
}

/// Prints the answer as one JSON object.
pub fn answer_json(value: &impl Serialize) -> anyhow::Result<()> {
    let mut text = serde_json::to_string_pretty(value)?;
    text.push('\n');
    answer(&text)
}

/// Prints one JSON object on a line of its own.
pub fn answer_json_line(value: &impl Serialize) -> anyhow::Result<()> {
    let mut text = serde_json::to_string(value)?;
    text.push('\n');
    answer(&text)
}

/// Refuses an output file whose folder does not exist or that is one, before long work and not after it.
pub fn check_folder(path: &Path) -> anyhow::Result<()> {
    if path.is_dir() {
        bail!("{}: a folder, where a file is wanted", path.display());
    }
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() && !folder.is_dir() => {
            bail!("{}: there is no folder {}", path.display(), folder.display())
        }
        _ => Ok(()),
    }
}

/// Runs `work` on so many threads; on all there are where none are told.
pub fn on_threads<T: Send>(
    threads: Option<std::num::NonZeroUsize>,
    work: impl FnOnce() -> T + Send,
) -> anyhow::Result<T> {
    let Some(threads) = threads else { return Ok(work()) };
    Ok(rayon::ThreadPoolBuilder::new().num_threads(threads.get()).build()?.install(work))
}

/// Prints a line to stderr; there is nowhere to report a stderr that is gone.
pub fn note(line: &str) {
    let _ = writeln!(io::stderr(), "{line}");
}

/// The step under way, shown in one line of the terminal and wiped at the end; silent where there is no terminal.
pub struct Progress {
    terminal: Option<io::Stderr>,
}

impl Progress {
    pub fn new() -> Self {
        let stderr = io::stderr();
        Self { terminal: stderr.is_terminal().then_some(stderr) }
    }

    pub fn step(&mut self, what: &str) {
        self.write(&format!("\r\x1b[2K{what} …"));
    }

    fn write(&mut self, text: &str) {
        if let Some(stderr) = &mut self.terminal {
            let _ = stderr.write_all(text.as_bytes()).and_then(|()| stderr.flush());
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.write("\r\x1b[2K");
    }
}
