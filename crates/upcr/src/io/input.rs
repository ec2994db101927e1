//! What the readers read from, and what they say when it fails.

use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom};

/// Why a file could not be read or written; the path and the format's name are added in one place, outside.
#[derive(Debug)]
pub(super) enum Fault {
    /// The operating system refused.
    Io(io::Error),
    /// The bytes are not what the format demands.
    Malformed(String),
    /// The format, or this library, cannot do that.
    Unsupported(String),
}

/// Result of a format's reader or writer.
pub(super) type Fallible<T> = Result<T, Fault>;

impl From<io::Error> for Fault {
    fn from(error: io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::UnexpectedEof => Self::Malformed("the file ends too early".into()),
            io::ErrorKind::InvalidData => Self::Malformed(error.to_string()),
            _ => Self::Io(error),
        }
    }
}

/// A malformed file, and why.
pub(super) fn malformed<T>(reason: impl Into<String>) -> Fallible<T> {
    Err(Fault::Malformed(reason.into()))
}

/// Something the format or this library does not do.
pub(super) fn unsupported<T>(reason: impl Into<String>) -> Fallible<T> {
    Err(Fault::Unsupported(reason.into()))
}

/// Bytes with a position: an open file, or memory.
pub(super) trait Stream: Read + Seek {}
impl<T: Read + Seek> Stream for T {}

/// Longest line that is taken for text; more means a binary file read as text.
const LONGEST_LINE: u64 = 1 << 20;

/// Points that any compressed file may hold, and more for each of its bytes: all alike, billions of them would fit into
/// a megabyte. No measurement comes near.
const MOST_POINTS: u64 = 1 << 23;
const MOST_POINTS_A_BYTE: u64 = 8;

/// Bytes of records read in one go.
const CHUNK: usize = 1 << 20;

/// An open file, or what stands for one: buffered, of known length, with a count of its lines where it is text.
pub(super) struct Input<'a> {
    pub(super) stream: BufReader<Box<dyn Stream + 'a>>,
    /// Length of the whole file in bytes.
    pub(super) len: u64,
    /// Number of the last line that was read, from 1.
    pub(super) line_number: usize,
}

impl<'a> Input<'a> {
    pub(super) fn new(mut stream: impl Stream + 'a) -> io::Result<Self> {
        let len = stream.seek(SeekFrom::End(0))?;
        stream.rewind()?;
        let stream: Box<dyn Stream + 'a> = Box::new(stream);
        Ok(Self { stream: BufReader::with_capacity(1 << 16, stream), len, line_number: 0 })
    }

    /// Bytes from here to the end of the file.
    pub(super) fn remaining(&mut self) -> io::Result<u64> {
        Ok(self.len.saturating_sub(self.stream.stream_position()?))
    }

    /// Fails where `count` records of at least `stride` bytes cannot follow, before anything is allocated.
    pub(super) fn check_claim(&mut self, what: &str, count: u64, stride: u64) -> Fallible<()> {
        let remaining = self.remaining()?;
        match count.checked_mul(stride) {
            Some(bytes) if bytes <= remaining => Ok(()),
            _ => malformed(format!(
                "the header claims {count} {what} of at least {stride} bytes, but only {remaining} bytes follow"
            )),
        }
    }

    /// Skips `bytes` bytes that must be there.
    pub(super) fn skip(&mut self, bytes: u64) -> Fallible<()> {
        self.check_claim("skipped bytes", bytes, 1)?;
        Ok(self.stream.seek_relative(bytes as i64)?)
    }

    /// Hands `count` records of `stride` bytes to `each`, reading them in chunks.
    pub(super) fn for_each_record(
        &mut self,
        count: u64,
        stride: usize,
        mut each: impl FnMut(&[u8]),
    ) -> Fallible<()> {
        self.check_claim("records", count, stride as u64)?;
        let per_chunk = (CHUNK / stride.max(1)).max(1) as u64;
        let mut buffer = vec![0; count.min(per_chunk) as usize * stride];
        let mut left = count;
        while left > 0 && stride > 0 {
            let now = left.min(per_chunk);
            let chunk = &mut buffer[..now as usize * stride];
            self.stream.read_exact(chunk)?;
            chunk.chunks_exact(stride).for_each(&mut each);
            left -= now;
        }
        Ok(())
    }

    /// Exactly `N` bytes.
    pub(super) fn array<const N: usize>(&mut self) -> Fallible<[u8; N]> {
        let mut bytes = [0; N];
        self.stream.read_exact(&mut bytes)?;
        Ok(bytes)
    }

    /// Exactly `count` bytes; the file is known to be no shorter before they are allocated.
    pub(super) fn bytes(&mut self, count: u64) -> Fallible<Vec<u8>> {
        self.check_claim("bytes", count, 1)?;
        let mut bytes = vec![0; count as usize];
        self.stream.read_exact(&mut bytes)?;
        Ok(bytes)
    }

    /// The next line into `line`, without its end; `false` at the end of the file.
    pub(super) fn line(&mut self, line: &mut String) -> Fallible<bool> {
        let mut raw = std::mem::take(line).into_bytes();
        raw.clear();
        if (&mut self.stream).take(LONGEST_LINE).read_until(b'\n', &mut raw)? == 0 {
            return Ok(false);
        }
        self.line_number += 1;
        if raw.len() as u64 == LONGEST_LINE {
            return malformed(format!("line {} is too long for text", self.line_number));
        }
        while raw.last().is_some_and(|b| matches!(b, b'\n' | b'\r')) {
            raw.pop();
        }
        // Comments in old encodings are no reason to refuse a file.
        *line = String::from_utf8(raw).unwrap_or_else(|e| String::from_utf8_lossy(e.as_bytes()).into_owned());
        Ok(true)
    }

    /// The next line that is neither blank nor, after `#`, comment only; a trailing comment is cut off.
    pub(super) fn content_line(&mut self, line: &mut String) -> Fallible<bool> {
        while self.line(line)? {
            if let Some(at) = line.find('#') {
                line.truncate(at);
            }
            if !line.trim().is_empty() {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// A malformed file, and why, at the line read last.
    pub(super) fn bad_line<T>(&self, reason: impl std::fmt::Display) -> Fallible<T> {
        malformed(format!("line {}: {reason}", self.line_number))
    }
}

/// Fails where a file of `len` bytes is too short for `count` compressed points that are not nearly all alike.
pub(super) fn check_expansion(len: u64, count: u64) -> Fallible<()> {
    if count > MOST_POINTS.saturating_add(len.saturating_mul(MOST_POINTS_A_BYTE)) {
        return malformed(format!("{count} points are too many for a file of {len} bytes"));
    }
    Ok(())
}

/// The words of a text file one after the other, wherever its lines end.
#[derive(Default)]
pub(super) struct Words {
    line: String,
    at: usize,
}

impl Words {
    /// The next word; the end of the file is a fault.
    pub(super) fn next<'a>(&'a mut self, input: &mut Input) -> Fallible<&'a str> {
        loop {
            let rest = &self.line[self.at..];
            let start = rest.len() - rest.trim_ascii_start().len();
            if start < rest.len() {
                let begin = self.at + start;
                let word = &self.line[begin..];
                let end = begin + word.find(|c: char| c.is_ascii_whitespace()).unwrap_or(word.len());
                self.at = end;
                return Ok(&self.line[begin..end]);
            }
            self.at = 0;
            if !input.line(&mut self.line)? {
                return malformed("the file ends too early");
            }
        }
    }

    /// The next word as a number.
    pub(super) fn number(&mut self, input: &mut Input) -> Fallible<f64> {
        let word = self.next(input)?;
        word.parse().or_else(|_| input.bad_line(format!("`{word}` is not a number")))
    }
}

/// The first three words of a line as a position.
pub(super) fn position<'a>(input: &Input, mut words: impl Iterator<Item = &'a str>) -> Fallible<[f64; 3]> {
    let mut point = [0.0; 3];
    for coordinate in &mut point {
        let Some(word) = words.next() else { return input.bad_line("three coordinates are needed") };
        let Ok(value) = word.parse() else { return input.bad_line(format!("`{word}` is not a number")) };
        *coordinate = value;
    }
    Ok(point)
}
