//! NumPy's NPZ: a ZIP archive of arrays, each an NPY file, stored or deflated. Arrays are read as streams, for they
//! may be much larger than the archive.

use std::io::{self, Read};
use std::path::{Path, PathBuf};

use flate2::read::DeflateDecoder;
use upcr::{Error, Result};

use super::number::{Kind, Number};

/// An archive, all of it in memory.
pub(super) struct Npz {
    path: PathBuf,
    bytes: Vec<u8>,
}

/// An array that is being read, row after row.
pub(super) struct Array<'a> {
    path: &'a Path,
    /// Rows, and then how large a row is.
    pub(super) shape: Vec<usize>,
    pub(super) number: Number,
    stream: Box<dyn Read + 'a>,
}

/// Signatures of a ZIP archive's records.
const END: &[u8] = b"PK\x05\x06";
const ENTRY: &[u8] = b"PK\x01\x02";
const LOCAL: &[u8] = b"PK\x03\x04";
/// Sizes of these records before what varies.
const END_SIZE: usize = 22;
const ENTRY_SIZE: usize = 46;
const LOCAL_SIZE: usize = 30;
/// Longest comment that may follow the end record.
const LONGEST_COMMENT: usize = 0xffff;
/// Largest row of an array.
const LARGEST_ROW: usize = 1 << 26;

impl Npz {
    pub(super) fn open(path: &Path) -> Result<Self> {
        let path = path.to_owned();
        match std::fs::read(&path) {
            Ok(bytes) => Ok(Self { path, bytes }),
            Err(source) => Err(Error::Io { path, source }),
        }
    }

    /// The array `name`.
    pub(super) fn array(&self, name: &str) -> Result<Array<'_>> {
        let Some((method, stored)) = member(&self.bytes, &format!("{name}.npy")) else {
            return Err(malformed(&self.path, format!("the archive is broken or has no array `{name}`")));
        };
        let stream: Box<dyn Read> = match method {
            0 => Box::new(stored),
            8 => Box::new(DeflateDecoder::new(stored)),
            _ => return Err(unsupported(&self.path, format!("compression method {method} of `{name}`"))),
        };
        Array::read(&self.path, stream)
    }
}

/// Method of compression and bytes of a member of a ZIP archive.
fn member<'a>(zip: &'a [u8], name: &str) -> Option<(u64, &'a [u8])> {
    // The end record is the last, but for a comment.
    let last = zip.len().checked_sub(END_SIZE)?;
    let end = (last.saturating_sub(LONGEST_COMMENT)..=last).rev().find(|&at| zip[at..].starts_with(END))?;
    let mut entry = number_at(zip, end + 16, 4)?;
    while zip.get(entry..)?.starts_with(ENTRY) {
        let [name_size, extra, comment] = [28, 30, 32].map(|field| number_at(zip, entry + field, 2));
        let name_at = entry + ENTRY_SIZE;
        let rest = name_at + name_size?;
        if zip.get(name_at..rest)? == name.as_bytes() {
            let [method, size, local] =
                [(10, 2), (20, 4), (42, 4)].map(|(f, n)| number_at(zip, entry + f, n));
            let local = local?;
            if !zip.get(local..)?.starts_with(LOCAL) {
                return None;
            }
            let [name_size, extra] = [26, 28].map(|field| number_at(zip, local + field, 2));
            let start = local + LOCAL_SIZE + name_size? + extra?;
            return Some((method? as u64, zip.get(start..start.checked_add(size?)?)?));
        }
        entry = rest + extra? + comment?;
    }
    None
}

/// A little-endian number of `size` bytes, 4 at most.
fn number_at(bytes: &[u8], at: usize, size: usize) -> Option<usize> {
    let bytes = bytes.get(at..at.checked_add(size)?)?;
    Some(bytes.iter().rev().fold(0, |value, &byte| value << 8 | usize::from(byte)))
}

impl<'a> Array<'a> {
    /// The header of an NPY file.
    fn read(path: &'a Path, mut stream: Box<dyn Read + 'a>) -> Result<Self> {
        let mut header = || -> io::Result<_> {
            let mut head = [0; 8];
            stream.read_exact(&mut head)?;
            let mut length = [0; 4];
            stream.read_exact(&mut length[..if head[6] == 1 { 2 } else { 4 }])?;
            let mut text = String::new();
            (&mut stream)
                .take(u64::from(u32::from_le_bytes(length)).min(1 << 16))
                .read_to_string(&mut text)?;
            Ok((head, text))
        };
        let (head, text) = header().map_err(|error| broken(path, &error))?;
        if !head.starts_with(b"\x93NUMPY") {
            return Err(malformed(path, "a member is no NPY file".into()));
        }
        if entry(&text, "fortran_order").is_none_or(|value| !value.starts_with("False")) {
            return Err(unsupported(path, "arrays in column-major order cannot be read".into()));
        }
        let shape: Option<Vec<usize>> = entry(&text, "shape").and_then(|value| {
            let (inside, _) = value.strip_prefix('(')?.split_once(')')?;
            inside.split(',').map(str::trim).filter(|n| !n.is_empty()).map(|n| n.parse().ok()).collect()
        });
        let number = entry(&text, "descr").and_then(number_of);
        match (shape, number) {
            (Some(shape), Some(number)) if !shape.is_empty() => Ok(Self { path, shape, number, stream }),
            _ => Err(unsupported(path, format!("no array of plain numbers: {}", text.trim()))),
        }
    }

    /// The next row's bytes into `row`.
    pub(super) fn next_row(&mut self, row: &mut Vec<u8>) -> Result<()> {
        let size = self.shape[1..].iter().try_fold(self.number.size, |size, &n| size.checked_mul(n));
        let Some(size @ 0..=LARGEST_ROW) = size else {
            return Err(malformed(self.path, format!("an array of shape {:?}", self.shape)));
        };
        row.resize(size, 0);
        self.stream.read_exact(row).map_err(|error| broken(self.path, &error))
    }
}

/// What follows `'key':` in a header.
fn entry<'a>(header: &'a str, key: &str) -> Option<&'a str> {
    let (_, after) = header.split_once(&format!("'{key}'"))?;
    Some(after.trim_start().strip_prefix(':')?.trim_start())
}

/// What NumPy calls e.g. `'<i4'`.
fn number_of(descr: &str) -> Option<Number> {
    let mut text = descr.strip_prefix('\'')?.split('\'').next()?.chars();
    let big_endian = text.next()? == '>';
    let kind = match text.next()? {
        'i' => Kind::Signed,
        'u' | 'b' => Kind::Unsigned,
        'f' => Kind::Float,
        _ => return None,
    };
    match (kind, text.as_str().parse().ok()?) {
        (Kind::Float, size @ (4 | 8)) | (Kind::Signed | Kind::Unsigned, size @ (1 | 2 | 4 | 8)) => {
            Some(Number { kind, size, big_endian })
        }
        _ => None,
    }
}

/// What the stream's error says of the file: it was in memory whole.
fn broken(path: &Path, error: &io::Error) -> Error {
    match error.kind() {
        io::ErrorKind::UnexpectedEof => malformed(path, "an array ends too early".into()),
        _ => malformed(path, error.to_string()),
    }
}

fn malformed(path: &Path, reason: String) -> Error {
    Error::Malformed { path: path.to_owned(), format: "NPZ", reason }
}

fn unsupported(path: &Path, reason: String) -> Error {
    Error::Unsupported { path: path.to_owned(), reason }
}
