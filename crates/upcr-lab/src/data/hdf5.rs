//! HDF5, as far as published data sets use it: numeric datasets of the root group, contiguous or in chunks, with
//! deflate and shuffle. After the HDF5 File Format Specification 3.0, whose section numbers stand in the comments.

use std::cell::Cell;
use std::io::Read;
use std::path::{Path, PathBuf};

use flate2::read::ZlibDecoder;
use rayon::prelude::*;
use upcr::{Error, Result};

use super::number::{Kind, Number};

/// An open file, all of it in memory.
pub(super) struct Hdf5 {
    path: PathBuf,
    bytes: Vec<u8>,
}

/// A dataset's numbers in row-major order.
#[derive(Debug, PartialEq)]
pub(super) struct Array {
    pub(super) shape: Vec<usize>,
    /// Rounded to single precision.
    pub(super) values: Vec<f32>,
}

impl Hdf5 {
    pub(super) fn open(path: &Path) -> Result<Self> {
        let path = path.to_owned();
        match std::fs::read(&path) {
            Ok(bytes) => Ok(Self { path, bytes }),
            Err(source) => Err(Error::Io { path, source }),
        }
    }

    /// The dataset `name` of the root group.
    pub(super) fn dataset(&self, name: &str) -> Result<Array> {
        read_dataset(&self.bytes, name).map_err(|fault| match fault {
            Fault::Malformed(reason) => Error::Malformed { path: self.path.clone(), format: "HDF5", reason },
            Fault::Unsupported(reason) => Error::Unsupported { path: self.path.clone(), reason },
        })
    }
}

#[derive(Debug)]
enum Fault {
    Malformed(String),
    Unsupported(String),
}

type Fallible<T> = Result<T, Fault>;

fn malformed<T>(reason: impl Into<String>) -> Fallible<T> {
    Err(Fault::Malformed(reason.into()))
}

fn unsupported<T>(reason: impl Into<String>) -> Fallible<T> {
    Err(Fault::Unsupported(reason.into()))
}

const SIGNATURE: &[u8] = b"\x89HDF\r\n\x1a\n";
/// The address of what is not there.
const UNDEFINED: u64 = u64::MAX;
/// Deflate shrinks to no less than a 1032nd.
const DEFLATE_LIMIT: usize = 1040;

/// The file, and how much of it may still be read. Its structures do not overlap, so that all of them together are
/// no longer than the file; what claims to be is a trap, such as a tree with a loop.
struct File<'a> {
    bytes: &'a [u8],
    budget: Cell<usize>,
}

impl<'a> File<'a> {
    fn block(&self, address: u64, length: u64) -> Fallible<Bytes<'a>> {
        let range = || {
            let start = usize::try_from(address).ok()?;
            let end = start.checked_add(usize::try_from(length).ok()?)?;
            self.budget.set(self.budget.get().checked_sub(end - start)?);
            self.bytes.get(start..end)
        };
        match range() {
            Some(bytes) => Ok(Bytes(bytes)),
            None => malformed(format!("{length} bytes at {address} are more than the file has")),
        }
    }
}

/// Bytes that are read from the front.
#[derive(Clone, Copy)]
struct Bytes<'a>(&'a [u8]);

impl<'a> Bytes<'a> {
    fn take(&mut self, count: usize) -> Fallible<&'a [u8]> {
        match self.0.split_at_checked(count) {
            Some((taken, rest)) => {
                self.0 = rest;
                Ok(taken)
            }
            None => malformed("a structure ends too early"),
        }
    }

    /// A little-endian number of `size` bytes, 8 at most.
    fn number(&mut self, size: usize) -> Fallible<u64> {
        Ok(self.take(size)?.iter().rev().fold(0, |value, &byte| value << 8 | u64::from(byte)))
    }

    fn byte(&mut self) -> Fallible<u8> {
        Ok(self.take(1)?[0])
    }

    fn demand(&mut self, mark: &[u8], what: &str) -> Fallible<()> {
        match self.0.strip_prefix(mark) {
            Some(rest) => {
                self.0 = rest;
                Ok(())
            }
            None => malformed(format!("{what} is not where it should be")),
        }
    }
}

/// IV.A.2: what an object's header says of it.
#[derive(Default)]
struct Header<'a> {
    messages: Vec<(u16, Message<'a>)>,
}

#[derive(Clone, Copy)]
struct Message<'a> {
    /// The content stands elsewhere.
    shared: bool,
    content: Bytes<'a>,
}

const DATASPACE: u16 = 0x01;
const LINK_INFO: u16 = 0x02;
const DATATYPE: u16 = 0x03;
const LINK: u16 = 0x06;
const LAYOUT: u16 = 0x08;
const FILTERS: u16 = 0x0b;
const CONTINUATION: u16 = 0x10;
const SYMBOL_TABLE: u16 = 0x11;

impl<'a> Header<'a> {
    fn read(file: &File<'a>, address: u64) -> Fallible<Self> {
        let mut header = Self::default();
        let mut prefix = file.block(address, 4)?;
        if prefix.0 == b"OHDR" {
            // Version 2: version, flags, and up to 28 bytes more, as the flags tell.
            let mut head = file.block(address.saturating_add(4), 2)?;
            let (version, flags) = (head.byte()?, head.byte()?);
            if version != 2 {
                return unsupported(format!("version {version} of object headers"));
            }
            let optional = if flags & 0x20 != 0 { 16 } else { 0 } + if flags & 0x10 != 0 { 4 } else { 0 };
            let width = 1 << (flags & 3);
            let mut sizes = file.block(address.saturating_add(6), optional + width)?;
            sizes.take(optional as usize)?;
            let length = sizes.number(width as usize)?;
            header.collect(
                file,
                file.block(address.saturating_add(6 + optional + width), length)?,
                Some(flags),
            )?;
        } else {
            let version = prefix.byte()?;
            if version != 1 {
                return malformed(format!("no object header at {address}"));
            }
            let length = file.block(address.saturating_add(8), 4)?.number(4)?;
            header.collect(file, file.block(address.saturating_add(16), length)?, None)?;
        }
        Ok(header)
    }

    /// Messages of a block and of those that continue it; `flags` are those of a header of version 2.
    fn collect(&mut self, file: &File<'a>, first: Bytes<'a>, flags: Option<u8>) -> Fallible<()> {
        // The bytes of the type, and those between a message's flags and its content.
        let (kind_size, gap) = match flags {
            None => (2, 3),
            Some(flags) => (1, if flags & 0x04 != 0 { 2 } else { 0 }),
        };
        let mut blocks = vec![first];
        while let Some(mut block) = blocks.pop() {
            while block.0.len() >= kind_size + 3 + gap {
                let kind = block.number(kind_size)? as u16;
                let size = block.number(2)? as usize;
                let shared = block.byte()? & 2 != 0;
                block.take(gap)?;
                let mut content = Bytes(block.take(size)?);
                if kind != CONTINUATION {
                    self.messages.push((kind, Message { shared, content }));
                    continue;
                }
                let (address, length) = (content.number(8)?, content.number(8)?);
                let mut more = file.block(address, length)?;
                if flags.is_some() {
                    more.demand(b"OCHK", "a header's continuation")?;
                    // A checksum ends it.
                    more.0 = &more.0[..more.0.len().saturating_sub(4)];
                }
                blocks.push(more);
            }
        }
        Ok(())
    }

    fn all(&self, kind: u16) -> impl Iterator<Item = Message<'a>> {
        self.messages.iter().filter(move |m| m.0 == kind).map(|m| m.1)
    }

    fn find(&self, kind: u16, what: &str) -> Fallible<Option<Bytes<'a>>> {
        match self.all(kind).next() {
            Some(message) if message.shared => unsupported(format!("a shared {what}")),
            message => Ok(message.map(|m| m.content)),
        }
    }

    fn need(&self, kind: u16, what: &str) -> Fallible<Bytes<'a>> {
        self.find(kind, what)?
            .map_or_else(|| malformed(format!("the object has no {what}, so is no dataset")), Ok)
    }
}

fn read_dataset(bytes: &[u8], name: &str) -> Fallible<Array> {
    let file = File { bytes, budget: Cell::new(bytes.len()) };
    let root = Header::read(&file, root_address(&file)?)?;
    let Some(address) = find_link(&file, &root, name)? else {
        return malformed(format!("there is no dataset `{name}`"));
    };
    let header = Header::read(&file, address)?;
    let shape = read_shape(header.need(DATASPACE, "dataspace")?)?;
    let number = read_number(header.need(DATATYPE, "datatype")?)?;
    let filters = match header.find(FILTERS, "filter pipeline")? {
        Some(message) => read_filters(message)?,
        None => Vec::new(),
    };
    let raw = read_layout(&file, header.need(LAYOUT, "layout")?, &shape, number.size, &filters)?;
    Ok(Array { shape, values: raw.chunks_exact(number.size).map(|bytes| number.decode(bytes)).collect() })
}

/// II: the superblock.
fn root_address(file: &File) -> Fallible<u64> {
    let mut block = file.block(0, file.bytes.len().min(96) as u64)?;
    block.demand(SIGNATURE, "the signature")?;
    let version = block.byte()?;
    // What is between the sizes of addresses and lengths and the base address, and from there to the root's.
    let (to_sizes, to_base, to_root) = match version {
        0 => (4, 9, 32),
        1 => (4, 13, 32),
        2 | 3 => (0, 1, 16),
        _ => return unsupported(format!("version {version} of the superblock")),
    };
    block.take(to_sizes)?;
    if block.take(2)? != [8, 8] {
        return unsupported("addresses and lengths of other than 8 bytes");
    }
    block.take(to_base)?;
    if block.number(8)? != 0 {
        return unsupported("a file that does not start at its own address 0");
    }
    block.take(to_root)?;
    block.number(8)
}

/// The header address of the object `name` in a group.
fn find_link(file: &File, group: &Header, name: &str) -> Fallible<Option<u64>> {
    if let Some(mut table) = group.find(SYMBOL_TABLE, "symbol table")? {
        let (tree, heap) = (table.number(8)?, table.number(8)?);
        // III.D: the names.
        let mut head = file.block(heap, 32)?;
        head.demand(b"HEAP", "a group's heap")?;
        head.take(4)?;
        let length = head.number(8)?;
        head.take(8)?;
        let names = file.block(head.number(8)?, length)?;
        return find_symbol(file, tree, None, names, name.as_bytes());
    }
    for message in group.all(LINK) {
        // IV.A.2.g
        let mut link = message.content;
        link.take(1)?;
        let flags = link.byte()?;
        let kind = if flags & 0x08 != 0 { link.byte()? } else { 0 };
        link.take(if flags & 0x04 != 0 { 8 } else { 0 } + usize::from(flags >> 4 & 1))?;
        let length = link.number(1 << (flags & 3))?;
        if link.take(length as usize)? == name.as_bytes() && kind == 0 {
            return Ok(Some(link.number(8)?));
        }
    }
    if let Some(mut info) = group.find(LINK_INFO, "link info")? {
        // IV.A.2.c
        info.take(1)?;
        let flags = info.byte()?;
        info.take(if flags & 1 != 0 { 8 } else { 0 })?;
        if info.number(8)? != UNDEFINED {
            return unsupported("a group of so many links that they stand in a heap");
        }
    }
    Ok(None)
}

/// III.A.1 and III.B: down a group's tree, whose leaves are tables of symbols. `above` is the level of the parent.
fn find_symbol(
    file: &File,
    address: u64,
    above: Option<u8>,
    names: Bytes,
    name: &[u8],
) -> Fallible<Option<u64>> {
    if above == Some(0) {
        let mut head = file.block(address, 8)?;
        head.demand(b"SNOD", "a table of symbols")?;
        head.take(2)?;
        let count = head.number(2)?;
        let mut entries = file.block(address.saturating_add(8), count * 40)?;
        for _ in 0..count {
            let mut found = names;
            found.take(entries.number(8)? as usize)?;
            let address = entries.number(8)?;
            entries.take(24)?;
            if found.0.strip_prefix(name).is_some_and(|rest| rest.first() == Some(&0)) {
                return Ok(Some(address));
            }
        }
        return Ok(None);
    }
    let node = TreeNode::read(file, address, above, 0)?;
    let mut entries = file.block(node.entries_at, node.count * 16)?;
    for _ in 0..node.count {
        entries.take(8)?;
        let found = find_symbol(file, entries.number(8)?, Some(node.level), names, name)?;
        if found.is_some() {
            return Ok(found);
        }
    }
    Ok(None)
}

/// III.A.1: the head of a version 1 B-tree's node.
struct TreeNode {
    level: u8,
    count: u64,
    /// Where keys and children follow.
    entries_at: u64,
}

impl TreeNode {
    fn read(file: &File, address: u64, above: Option<u8>, kind: u8) -> Fallible<Self> {
        let mut head = file.block(address, 24)?;
        head.demand(b"TREE", "a node of a tree")?;
        let (found, level, count) = (head.byte()?, head.byte()?, head.number(2)?);
        if found != kind || above.is_some_and(|above| level.checked_add(1) != Some(above)) {
            return malformed("a node of another tree");
        }
        Ok(Self { level, count, entries_at: address.saturating_add(24) })
    }
}

/// IV.A.2.b
fn read_shape(mut message: Bytes) -> Fallible<Vec<usize>> {
    let (version, rank, _flags) = (message.byte()?, message.byte()?, message.byte()?);
    match version {
        1 => message.take(5)?,
        2 => message.take(1)?,
        _ => return unsupported(format!("version {version} of dataspaces")),
    };
    (0..rank).map(|_| message.number(8).map(|n| n as usize)).collect()
}

/// IV.A.2.d
fn read_number(mut message: Bytes) -> Fallible<Number> {
    let class = message.byte()? & 0x0f;
    let flags = message.number(3)?;
    let size = message.number(4)? as usize;
    // Bit offset and precision; then, of floats, where exponent and mantissa are.
    let (offset, precision) = (message.number(2)?, message.number(2)?);
    let kind = match (class, size) {
        (0, 1 | 2 | 4 | 8) if flags & 0x08 != 0 => Kind::Signed,
        (0, 1 | 2 | 4 | 8) => Kind::Unsigned,
        (1, 4) if message.take(4)? == [23, 8, 0, 23] => Kind::Float,
        (1, 8) if message.take(4)? == [52, 11, 0, 52] => Kind::Float,
        _ => return unsupported(format!("data of class {class} and {size} bytes, not plain numbers")),
    };
    if (offset, precision) != (0, 8 * size as u64) || flags & 0x40 != 0 {
        return unsupported("numbers that do not fill their bytes");
    }
    Ok(Number { kind, size, big_endian: flags & 1 != 0 })
}

#[derive(Clone, Copy, PartialEq)]
enum Filter {
    Deflate,
    /// First bytes of all elements, then second bytes, and so on.
    Shuffle,
}

/// IV.A.2.l: in the order in which they were applied.
fn read_filters(mut message: Bytes) -> Fallible<Vec<Filter>> {
    let (version, count) = (message.byte()?, message.byte()?);
    match version {
        1 => drop(message.take(6)?),
        2 => {}
        _ => return unsupported(format!("version {version} of filter pipelines")),
    }
    let mut filters = Vec::new();
    for _ in 0..count {
        let id = message.number(2)?;
        let name = if version == 1 || id >= 256 { message.number(2)? as usize } else { 0 };
        message.take(2)?;
        let values = message.number(2)? as usize;
        let pad = version == 1;
        message.take(if pad { name.next_multiple_of(8) } else { name })?;
        message.take(4 * if pad { values.next_multiple_of(2) } else { values })?;
        filters.push(match id {
            1 => Filter::Deflate,
            2 => Filter::Shuffle,
            _ => return unsupported(format!("the filter numbered {id}; deflate and shuffle are known")),
        });
    }
    Ok(filters)
}

/// IV.A.2.i: the dataset's bytes in row-major order.
fn read_layout(
    file: &File,
    mut message: Bytes,
    shape: &[usize],
    size: usize,
    filters: &[Filter],
) -> Fallible<Vec<u8>> {
    let product = shape.iter().try_fold(size, |product, &n| product.checked_mul(n));
    let Some(length) = product else { return malformed(format!("the shape {shape:?}")) };
    let (version, class) = (message.byte()?, message.byte()?);
    let stored = match (version, class) {
        (3 | 4, 0) => {
            let length = message.number(2)? as usize;
            message.take(length)?
        }
        (3 | 4, 1) => {
            let (address, stored) = (message.number(8)?, message.number(8)?);
            if length == 0 { &[] } else { file.block(address, stored)?.0 }
        }
        (3, 2) => {
            if usize::from(message.byte()?) != shape.len() + 1 {
                return malformed("chunks of another rank than the dataset's");
            }
            let tree = message.number(8)?;
            let dims: Vec<usize> =
                shape.iter().map(|_| message.number(4).map(|n| n as usize)).collect::<Fallible<_>>()?;
            if message.number(4)? as usize != size {
                return malformed("chunks of another element size than the dataset's");
            }
            let chunks = Chunks { shape, dims, size, filters };
            return if length == 0 { Ok(Vec::new()) } else { chunks.read(file, tree, length) };
        }
        (4.., 2) => return unsupported("chunks indexed in a way of HDF5 1.10 or later"),
        _ => return unsupported(format!("layout version {version}, class {class}")),
    };
    if stored.len() == length {
        Ok(stored.to_vec())
    } else {
        malformed("a dataset of another size than its shape's")
    }
}

/// A dataset cut into chunks; those at the edges overhang.
struct Chunks<'a> {
    shape: &'a [usize],
    dims: Vec<usize>,
    size: usize,
    filters: &'a [Filter],
}

/// One chunk as stored.
struct Chunk<'a> {
    /// Index of its first element.
    offset: Vec<usize>,
    /// Filters that were left out, one bit each.
    skipped: u64,
    bytes: &'a [u8],
}

impl Chunks<'_> {
    fn read(&self, file: &File, tree: u64, length: usize) -> Fallible<Vec<u8>> {
        let chunk_length = self.dims.iter().try_fold(self.size, |product, &n| product.checked_mul(n));
        let Some(chunk_length @ 1..) = chunk_length else {
            return malformed(format!("chunks of {:?}", self.dims));
        };
        let mut chunks = Vec::new();
        self.collect(file, tree, None, &mut chunks)?;
        let grid = self.shape.iter().zip(&self.dims).map(|(n, d)| n.div_ceil(*d));
        if grid.product::<usize>() != chunks.len() {
            return unsupported("a dataset of which not every chunk is stored");
        }
        chunks.sort_unstable_by(|a, b| a.offset.cmp(&b.offset));
        if chunks.windows(2).any(|pair| pair[0].offset == pair[1].offset) {
            return malformed("two chunks in one place");
        }
        let unpacked: Vec<_> =
            chunks.par_iter().map(|chunk| self.unpack(chunk, chunk_length)).collect::<Fallible<_>>()?;
        let mut raw = vec![0; length];
        for (chunk, bytes) in chunks.iter().zip(&unpacked) {
            self.place(&chunk.offset, bytes, &mut raw);
        }
        Ok(raw)
    }

    /// III.A.1: the chunks of a node and of those below it.
    fn collect<'b>(
        &self,
        file: &File<'b>,
        address: u64,
        above: Option<u8>,
        chunks: &mut Vec<Chunk<'b>>,
    ) -> Fallible<()> {
        let node = TreeNode::read(file, address, above, 1)?;
        // A key is size, skipped filters and the offset, which has one dimension more: that of the bytes.
        let entry = 8 + 8 * (self.shape.len() as u64 + 1) + 8;
        let mut entries = file.block(node.entries_at, node.count * entry)?;
        for _ in 0..node.count {
            let (stored, skipped) = (entries.number(4)?, entries.number(4)?);
            let offset: Vec<usize> = (self.shape.iter())
                .map(|_| entries.number(8).map(|n| n as usize))
                .collect::<Fallible<_>>()?;
            entries.take(8)?;
            let child = entries.number(8)?;
            if node.level > 0 {
                self.collect(file, child, Some(node.level), chunks)?;
                continue;
            }
            let mut axes = offset.iter().zip(self.shape).zip(&self.dims);
            if axes.any(|((o, n), d)| o >= n || o % d != 0) {
                return malformed(format!("a chunk at {offset:?}"));
            }
            chunks.push(Chunk { offset, skipped, bytes: file.block(child, stored)?.0 });
        }
        Ok(())
    }

    /// Undoes the filters.
    fn unpack(&self, chunk: &Chunk, length: usize) -> Fallible<Vec<u8>> {
        let mut bytes = chunk.bytes.to_vec();
        for (i, filter) in self.filters.iter().enumerate().rev() {
            if chunk.skipped >> i & 1 != 0 {
                continue;
            }
            bytes = match filter {
                Filter::Deflate => inflate(&bytes, length)?,
                Filter::Shuffle => unshuffle(&bytes, self.size),
            };
        }
        if bytes.len() == length { Ok(bytes) } else { malformed("a chunk of the wrong size") }
    }

    /// Copies a chunk to its place in the whole, row by row, less what overhangs.
    fn place(&self, offset: &[usize], chunk: &[u8], raw: &mut [u8]) {
        let Some((&row, outer)) = self.dims.split_last() else {
            raw.copy_from_slice(chunk);
            return;
        };
        let last = outer.len();
        let kept = row.min(self.shape[last] - offset[last]) * self.size;
        for (i, bytes) in chunk.chunks_exact(row * self.size).enumerate() {
            // The row's index along the outer axes, last axis first, and with it its place.
            let (mut rest, mut stride) = (i, self.shape[last]);
            let place = (0..last).rev().try_fold(offset[last], |at, axis| {
                let index = offset[axis] + rest % self.dims[axis];
                rest /= self.dims[axis];
                let step = stride;
                stride *= self.shape[axis];
                (index < self.shape[axis]).then(|| at + index * step)
            });
            if let Some(at) = place {
                raw[at * self.size..][..kept].copy_from_slice(&bytes[..kept]);
            }
        }
    }
}

/// `length` bytes, and no more.
fn inflate(bytes: &[u8], length: usize) -> Fallible<Vec<u8>> {
    let mut plain = Vec::with_capacity(length.min(bytes.len().saturating_mul(DEFLATE_LIMIT)));
    match ZlibDecoder::new(bytes).take(length as u64 + 1).read_to_end(&mut plain) {
        Ok(_) => Ok(plain),
        Err(error) => malformed(format!("a compressed chunk: {error}")),
    }
}

fn unshuffle(bytes: &[u8], size: usize) -> Vec<u8> {
    let count = bytes.len() / size;
    let mut plain = Vec::with_capacity(bytes.len());
    for i in 0..count {
        plain.extend((0..size).map(|byte| bytes[byte * count + i]));
    }
    // What is no whole element stays where it is.
    plain.extend_from_slice(&bytes[count * size..]);
    plain
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Written by h5py; see tests/hdf5/make.py.
    const EARLIEST: &[u8] = include_bytes!("../../tests/hdf5/earliest.h5");
    const LATEST: &[u8] = include_bytes!("../../tests/hdf5/latest.h5");

    fn counted(shape: &[usize], value: fn(f32) -> f32) -> Array {
        let values = (0..shape.iter().product()).map(|i: usize| value(i as f32)).collect();
        Array { shape: shape.to_vec(), values }
    }

    #[test]
    fn datasets_are_those_that_h5py_wrote() {
        let quarters = |i| i / 4.0 - 3.0;
        for (file, name, expected) in [
            (EARLIEST, "data", counted(&[7, 5, 3], quarters)),
            (EARLIEST, "label", counted(&[7, 1], |i| i)),
            (EARLIEST, "gzip", counted(&[100, 3], quarters)),
            (EARLIEST, "plain", counted(&[9], |i| i)),
            (EARLIEST, "other17", counted(&[], |_| 17.0)),
            (LATEST, "data", counted(&[4, 3], quarters)),
            (LATEST, "label", counted(&[4, 1], |i| i)),
        ] {
            assert_eq!(read_dataset(file, name).unwrap(), expected, "{name}");
        }
    }

    #[test]
    fn what_cannot_be_read_is_said() {
        for (file, name, expected) in [
            (EARLIEST, "nothing", "there is no dataset `nothing`"),
            (EARLIEST, "text", "not plain numbers"),
            (EARLIEST, "checked", "the filter numbered 3"),
            (LATEST, "chunked", "HDF5 1.10"),
            (b"no HDF5".as_slice(), "data", "the signature"),
            (b"nothing that looks like HDF5 at all".as_slice(), "data", "the signature"),
        ] {
            let (Fault::Malformed(reason) | Fault::Unsupported(reason)) =
                read_dataset(file, name).unwrap_err();
            assert!(reason.contains(expected), "{name}: {reason}");
        }
    }

    #[test]
    fn truncated_files_are_refused() {
        for length in 0..EARLIEST.len() {
            // What is cut off may belong to another dataset.
            if let Ok(array) = read_dataset(&EARLIEST[..length], "data") {
                assert_eq!(array, read_dataset(EARLIEST, "data").unwrap());
            }
        }
        assert!(read_dataset(&EARLIEST[..EARLIEST.len() / 4], "data").is_err());
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(3000))]
        #[test]
        fn broken_files_are_no_trap(
            latest: bool,
            breaks in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
        ) {
            let mut file = if latest { LATEST } else { EARLIEST }.to_vec();
            for (at, value) in breaks {
                let at = at.index(file.len());
                file[at] = value;
            }
            for name in ["data", "label", "plain"] {
                if let Ok(array) = read_dataset(&file, name) {
                    prop_assert_eq!(array.values.len(), array.shape.iter().product::<usize>());
                }
            }
        }
    }
}
