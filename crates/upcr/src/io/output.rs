//! Files that are written whole or not at all.

use std::fs::File;
use std::io::{self, BufWriter, Read, Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use super::input::Fallible;

/// A new file, or memory. E57 reads back what it wrote; LAZ compresses on several threads.
pub(super) trait Sink: Read + Write + Seek + Send + Sync {}
impl<T: Read + Write + Seek + Send + Sync> Sink for T {}

/// What the writers write to.
pub(super) type Output<'a> = BufWriter<Box<dyn Sink + 'a>>;

/// Hands a buffered `sink` to `write`.
pub(super) fn write_buffered<'a>(
    sink: impl Sink + 'a,
    write: impl FnOnce(&mut Output<'a>) -> Fallible<()>,
) -> Fallible<()> {
    let mut output = Output::with_capacity(1 << 16, Box::new(sink));
    write(&mut output)?;
    Ok(output.flush()?)
}

/// A file under a temporary name, removed when dropped unless it was given its final name.
struct Temporary {
    path: PathBuf,
    kept: bool,
}

impl Drop for Temporary {
    fn drop(&mut self) {
        if !self.kept {
            // A file that cannot be removed is no reason to hide the error that led here.
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

/// Writes `path` through `write`: into a new file beside it, then renamed over it.
pub(super) fn write_atomically(path: &Path, write: impl FnOnce(&mut Output) -> Fallible<()>) -> Fallible<()> {
    let (mut temporary, file) = create_beside(path)?;
    write_buffered(file, write)?;
    std::fs::rename(&temporary.path, path)?;
    temporary.kept = true;
    Ok(())
}

/// A new file in the folder of `path`.
fn create_beside(path: &Path) -> io::Result<(Temporary, File)> {
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    let name = path
        .file_name()
        .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "the path names no file"))?
        .to_string_lossy();
    loop {
        let serial = COUNTER.fetch_add(1, Ordering::Relaxed);
        let candidate = path.with_file_name(format!(".{name}.{serial}.tmp"));
        match File::options().read(true).write(true).create_new(true).open(&candidate) {
            Ok(file) => return Ok((Temporary { path: candidate, kept: false }, file)),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(error),
        }
    }
}
