//! The compressed points of LAZ: chunks that are decoded, and coded, in parallel.

use std::io::{Cursor, Seek, SeekFrom};
use std::panic::{AssertUnwindSafe, catch_unwind};

use ::laz::laszip::{ChunkTable, CompressorType};
use ::laz::record::{LayeredPointRecordDecompressor, RecordDecompressor, SequentialPointRecordDecompressor};
use ::laz::{
    DecompressionSelection, LazItem, LazItemRecordBuilder, LazItemType, LazVlr, LazVlrBuilder,
    ParLasZipCompressor,
};
use rayon::prelude::*;

use crate::PointCloud;

use super::super::input::{Fallible, Fault, Input, check_expansion, malformed, unsupported};
use super::super::output::Output;
use super::gps_time;
use super::header::{self, Header, RECORD_HEADER, padded};
use super::{Points, for_each_batch};

impl From<::laz::LasZipError> for Fault {
    fn from(error: ::laz::LasZipError) -> Self {
        match error {
            ::laz::LasZipError::IoError(error) => error.into(),
            other => Self::Malformed(other.to_string()),
        }
    }
}

/// Chunks that any file may have, and bytes for each further one: to decode one costs a millisecond, however few its
/// points.
const MOST_CHUNKS: u64 = 256;
const BYTES_A_CHUNK: u64 = 1024;

/// Compressed bytes of some points that do not depend on others.
struct Chunk {
    bytes: Vec<u8>,
    count: u64,
}

/// Reads the points, the input standing where they start.
pub(super) fn read(input: &mut Input, header: &Header) -> Fallible<Points> {
    let Some(description) = &header.laszip else { return malformed("nothing describes the compression") };
    let vlr = LazVlr::from_buffer(description)?;
    check_items(&vlr, header)?;
    check_expansion(input.len, header.count)?;
    let compressor = u16::from_le_bytes([description[0], description[1]]);
    let mut sizes = if compressor == CompressorType::PointWise as u16 {
        vec![(input.remaining()?, header.count)]
    } else {
        chunk_sizes(input, header, &vlr)?
    }
    .into_iter();

    let mut all = Points::default();
    loop {
        let mut batch = Vec::new();
        for (size, count) in sizes.by_ref().take(2 * rayon::current_num_threads()) {
            batch.push(Chunk { bytes: input.bytes(size)?, count });
        }
        if batch.is_empty() {
            return Ok(all);
        }
        let decoded: Vec<Fallible<Points>> =
            batch.into_par_iter().map(|chunk| decode(chunk, header, vlr.items())).collect();
        for points in decoded {
            all.append(points?);
        }
    }
}

/// Fails unless the compressed items are those of the point format, on which the decoder relies.
fn check_items(vlr: &LazVlr, header: &Header) -> Fallible<()> {
    let expected =
        LazItemRecordBuilder::default_for_point_format_id(header.point_format, header.extra_bytes())?;
    let shape = |items: &[LazItem]| -> Vec<_> { items.iter().map(|i| (i.item_type(), i.size())).collect() };
    let layered = |item: &LazItem| matches!(item.version(), 3 | 4);
    let items = vlr.items();
    if shape(items) != shape(&expected) || items.iter().any(|i| layered(i) != layered(&expected[0])) {
        return malformed("the compressed items are not those of the point format");
    }
    Ok(())
}

/// Bytes and points of each chunk, which together are the file's points.
fn chunk_sizes(input: &mut Input, header: &Header, vlr: &LazVlr) -> Fallible<Vec<(u64, u64)>> {
    let start = header.points_at;
    // The offset of the table, or -1 where a writer could not seek; then it is the last of the file.
    let mut table_at = i64::from_le_bytes(input.array()?);
    if table_at <= start as i64 {
        input.stream.seek(SeekFrom::End(-8))?;
        table_at = i64::from_le_bytes(input.array()?);
    }
    if table_at < start as i64 + 8 || table_at as u64 > input.len {
        return malformed("the table of compressed chunks is not where it should be");
    }
    input.stream.seek(SeekFrom::Start(table_at as u64 + 4))?;
    let chunks = u64::from(u32::from_le_bytes(input.array()?));
    let room = table_at as u64 - start;
    // Each holds at least one point, which is stored as it is.
    if chunks > header.count || chunks * u64::from(header.record_length) > room {
        return malformed(format!("the file claims {chunks} compressed chunks, more than fit in it"));
    }
    if chunks > MOST_CHUNKS + input.len / BYTES_A_CHUNK {
        return malformed(format!("{chunks} compressed chunks are too many for {} bytes", input.len));
    }
    input.stream.seek(SeekFrom::Start(start))?;
    let table = ChunkTable::read_from(&mut input.stream, vlr)?;
    let mut left = header.count;
    let mut sizes = Vec::with_capacity(chunks as usize);
    for entry in table.as_ref() {
        let count = entry.point_count.min(left);
        left -= count;
        sizes.push((entry.byte_count, count));
    }
    if left > 0 {
        return malformed(format!("the compressed chunks lack {left} of {} points", header.count));
    }
    Ok(sizes)
}

fn decode(chunk: Chunk, header: &Header, items: &[LazItem]) -> Fallible<Points> {
    let layered = matches!(items[0].version(), 3 | 4);
    if layered {
        check_layers(&chunk, header, items)?;
    }
    let bytes = Cursor::new(chunk.bytes);
    // The decoder takes the bytes for what a coder wrote, and may overrun its tables where they are not.
    catch_unwind(AssertUnwindSafe(|| {
        if layered {
            let mut decoder = LayeredPointRecordDecompressor::new(bytes);
            decoder.set_fields_from(&items.to_vec())?;
            decoder.set_selection(DecompressionSelection::base().decompress_z().decompress_rgb());
            decode_with(decoder, chunk.count, header)
        } else {
            let mut decoder = SequentialPointRecordDecompressor::new(bytes);
            for item in items {
                match (item.item_type(), item.version()) {
                    (LazItemType::GpsTime, 2) => decoder.add_field_decompressor(gps_time::Skipped::default()),
                    _ => decoder.set_fields_from(&vec![*item])?,
                }
            }
            decode_with(decoder, chunk.count, header)
        }
    }))
    .unwrap_or_else(|_| malformed("the compressed points are corrupt"))
}

fn decode_with(
    mut decoder: impl RecordDecompressor<Cursor<Vec<u8>>>,
    count: u64,
    header: &Header,
) -> Fallible<Points> {
    // Grows with what is really there, whatever the count claims.
    let mut points = Points::default();
    let mut record = vec![0; usize::from(header.record_length)];
    for _ in 0..count {
        decoder.decompress_next(&mut record)?;
        points.push(header, &record);
    }
    Ok(points)
}

/// Fails where the layers of a chunk claim more bytes than it has, before the decoder allocates them.
fn check_layers(chunk: &Chunk, header: &Header, items: &[LazItem]) -> Fallible<()> {
    let layers: usize = (items.iter())
        .map(|item| match item.item_type() {
            LazItemType::Point14 => 9,
            LazItemType::RGBNIR14 => 2,
            LazItemType::Byte14(count) => usize::from(count),
            _ => 1,
        })
        .sum();
    // The first point as it is, a count, and the length of every layer.
    let sizes = usize::from(header.record_length) + 4;
    let data = sizes + 4 * layers;
    let Some(sizes) = chunk.bytes.get(sizes..data) else {
        return malformed("a compressed chunk is too short");
    };
    let claimed: u64 =
        sizes.chunks_exact(4).map(|s| u64::from(u32::from_le_bytes([s[0], s[1], s[2], s[3]]))).sum();
    if claimed > (chunk.bytes.len() - data) as u64 {
        return malformed("the layers of a compressed chunk claim more bytes than it has");
    }
    Ok(())
}

pub(super) fn write(out: &mut Output, header: &Header, cloud: &PointCloud) -> Fallible<()> {
    let vlr = LazVlrBuilder::default().with_point_format(header.point_format, 0)?.build();
    let mut description = Vec::new();
    vlr.write_to(&mut description)?;
    let Ok(length) = u16::try_from(description.len()) else {
        return unsupported("too many compressed items");
    };
    let mut record = Vec::with_capacity(RECORD_HEADER + description.len());
    record.extend([0; 2]);
    record.extend(padded::<16>(LazVlr::USER_ID.as_bytes()));
    record.extend(LazVlr::RECORD_ID.to_le_bytes());
    record.extend(length.to_le_bytes());
    record.extend(padded::<32>(LazVlr::DESCRIPTION.as_bytes()));
    record.extend(description);
    header::write(out, header, cloud, &record)?;
    let mut compressor = ParLasZipCompressor::new(out, vlr)?;
    for_each_batch(cloud, header, |batch| Ok(compressor.compress_many(batch)?))?;
    Ok(compressor.done()?)
}

#[cfg(test)]
mod tests {
    use ::laz::encoders::ArithmeticEncoder;
    use ::laz::models::ArithmeticModelBuilder;
    use ::laz::record::{LayeredPointRecordCompressor, RecordCompressor};

    use super::*;

    /// A decoder that follows every change of the times' sequence by a call of its own fills its stack.
    #[test]
    fn a_layer_of_endless_changes_of_sequence_is_not_followed() {
        const RECORD: usize = 30;
        const LAYERS: usize = 9;
        let cloud = PointCloud::from_points((0..50).map(|i| [f64::from(i), 1.0, 2.0]).collect());
        let base = Header::for_cloud(&cloud).unwrap();
        let header = Header { compressed: true, point_format: 6, record_length: RECORD as u16, ..base };
        let mut records = Vec::new();
        for_each_batch(&cloud, &header, |batch| {
            records.extend_from_slice(batch);
            Ok(())
        })
        .unwrap();
        for (i, record) in records.chunks_exact_mut(RECORD).enumerate() {
            record[22..].copy_from_slice(&(i as u64 * 977).to_le_bytes());
        }
        let items = LazItemRecordBuilder::default_for_point_format_id(6, 0).unwrap();
        let mut coder = LayeredPointRecordCompressor::new(Cursor::new(Vec::new()));
        coder.set_fields_from(&items).unwrap();
        coder.compress_many(&records).unwrap();
        coder.done().unwrap();
        let mut bytes = coder.into_inner().into_inner();

        // The times' layer is the last. Its second of five symbols upward change the sequence.
        let mut model = ArithmeticModelBuilder::new(5).with_compression(true).build();
        let mut coder = ArithmeticEncoder::new(Cursor::new(Vec::new()));
        for _ in 0..1_000_000 {
            coder.encode_symbol(&mut model, 2).unwrap();
        }
        coder.done().unwrap();
        let changes = coder.into_inner().into_inner();
        let size_at = RECORD + 4 + 4 * (LAYERS - 1);
        let old = u32::from_le_bytes(bytes[size_at..size_at + 4].try_into().unwrap()) as usize;
        assert!(old > 0);
        bytes.truncate(bytes.len() - old);
        bytes[size_at..size_at + 4].copy_from_slice(&(changes.len() as u32).to_le_bytes());
        bytes.extend(changes);

        let found = decode(Chunk { bytes, count: 50 }, &header, &items).unwrap();
        assert_eq!(found.points, cloud.points);
    }
}
