//! GPS times of LAZ, passed over: nothing here asks for them, but they stand between the coordinates of one point and the
//! next, and the coder adapts to them.

use std::io::{Error, ErrorKind, Read, Result};

use ::laz::decoders::ArithmeticDecoder;
use ::laz::decompressors::{IntegerDecompressor, IntegerDecompressorBuilder};
use ::laz::models::{ArithmeticModel, ArithmeticModelBuilder};
use ::laz::record::FieldDecompressor;

/// Times run in up to so many sequences at once.
const SEQUENCES: usize = 4;
/// Contexts of the step from one time to the next.
const CONTEXTS: u32 = 9;
/// Steps predicted badly one after the other, after which the step itself is taken for the ordinary one.
const PATIENCE: u32 = 3;

/// Symbols where a sequence stands still; larger ones pass to another sequence.
const STILL_SYMBOLS: u32 = 6;
const STILL: u32 = 0;
const MOVES: u32 = 1;
const STARTS: u32 = 2;

/// Symbols where it moves: how many ordinary steps the next one is. Zero, the largest multiple and the last of the
/// negative ones stand for steps that are no multiple.
const MOVING_SYMBOLS: u32 = 516;
const LARGEST_MULTIPLE: u32 = 500;
const MOST_NEGATIVE: u32 = 510;
const UNCHANGED: u32 = 511;
const STARTS_ANEW: u32 = 512;

/// A sequence of times in ordinary steps.
#[derive(Debug, Clone, Copy, Default)]
struct Sequence {
    step: i32,
    surprises: u32,
}

/// Version 2 of the item. That of the `laz` crate calls itself for every change of sequence, and a made-up file may
/// change it without end.
pub(super) struct Skipped {
    sequences: [Sequence; SEQUENCES],
    /// The one that the last time belongs to, and the one that was started last.
    current: usize,
    newest: usize,
    still: ArithmeticModel,
    moving: ArithmeticModel,
    steps: IntegerDecompressor,
}

impl Default for Skipped {
    fn default() -> Self {
        Self {
            sequences: [Sequence::default(); SEQUENCES],
            current: 0,
            newest: 0,
            still: ArithmeticModelBuilder::new(STILL_SYMBOLS).build(),
            moving: ArithmeticModelBuilder::new(MOVING_SYMBOLS).build(),
            steps: IntegerDecompressorBuilder::new().bits(32).contexts(CONTEXTS).build_initialized(),
        }
    }
}

impl Skipped {
    /// Reads one time, or that it belongs to another sequence; then says so.
    fn changes_sequence<R: Read>(&mut self, decoder: &mut ArithmeticDecoder<R>) -> Result<bool> {
        let sequence = &mut self.sequences[self.current];
        let (symbol, starts) = if sequence.step == 0 {
            (decoder.decode_symbol(&mut self.still)?, STARTS)
        } else {
            (decoder.decode_symbol(&mut self.moving)?, STARTS_ANEW)
        };
        if symbol > starts {
            self.current = (self.current + (symbol - starts) as usize) % SEQUENCES;
            return Ok(true);
        }
        if symbol == starts {
            self.newest = (self.newest + 1) % SEQUENCES;
            self.current = self.newest;
            self.sequences[self.current] = Sequence::default();
            // The upper half of the time, and the lower as it is.
            self.steps.decompress(decoder, 0, 8)?;
            decoder.read_int()?;
            return Ok(false);
        }
        if sequence.step == 0 {
            if symbol == MOVES {
                *sequence = Sequence { step: self.steps.decompress(decoder, 0, 0)?, surprises: 0 };
            } else {
                debug_assert_eq!(symbol, STILL);
            }
            return Ok(false);
        }
        if symbol == UNCHANGED {
            return Ok(false);
        }
        let (multiple, context) = match symbol {
            0 => (0, 7),
            1 => (1, 1),
            2..10 => (symbol as i32, 2),
            10..LARGEST_MULTIPLE => (symbol as i32, 3),
            LARGEST_MULTIPLE => (symbol as i32, 4),
            MOST_NEGATIVE.. => (LARGEST_MULTIPLE as i32 - symbol as i32, 6),
            _ => (LARGEST_MULTIPLE as i32 - symbol as i32, 5),
        };
        let step = self.steps.decompress(decoder, sequence.step.wrapping_mul(multiple), context)?;
        match symbol {
            1 => sequence.surprises = 0,
            0 | LARGEST_MULTIPLE | MOST_NEGATIVE => {
                sequence.surprises += 1;
                if sequence.surprises > PATIENCE {
                    *sequence = Sequence { step, surprises: 0 };
                }
            }
            _ => {}
        }
        Ok(false)
    }
}

impl<R: Read> FieldDecompressor<R> for Skipped {
    fn size_of_field(&self) -> usize {
        size_of::<f64>()
    }

    fn decompress_first(&mut self, src: &mut R, first_point: &mut [u8]) -> Result<()> {
        src.read_exact(first_point)
    }

    fn decompress_with(&mut self, decoder: &mut ArithmeticDecoder<R>, _: &mut [u8]) -> Result<()> {
        // A coder passes straight to the sequence that it means.
        if self.changes_sequence(decoder)? && self.changes_sequence(decoder)? {
            return Err(Error::new(ErrorKind::InvalidData, "a GPS time changes its sequence twice"));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use ::laz::LazItemRecordBuilder;
    use ::laz::encoders::ArithmeticEncoder;
    use ::laz::record::{
        RecordCompressor, RecordDecompressor, SequentialPointRecordCompressor,
        SequentialPointRecordDecompressor,
    };
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// Bytes of a point before its time, and with it.
    const POINT: usize = 20;
    const RECORD: usize = 28;

    /// Times as sensors write them and as none would: standing still, in steps, in multiples of them, in several sequences
    /// by turns, and wild.
    fn times(rng: &mut impl Rng) -> Vec<i64> {
        let mut clocks = [0, 1 << 40, -1 << 50, 1 << 60, 7 << 45];
        let mut times = Vec::new();
        for _ in 0..20_000 {
            let clock = rng.random_range(0..clocks.len());
            let steps = match rng.random_range(0..10) {
                0 => vec![0; rng.random_range(1..20)],
                1 => vec![rng.random_range(-20_000_000..20_000_000)],
                2 => vec![rng.random_range(-600..600) * 1000],
                3 => vec![500_000, 500_000, -10_000, -10_000, -12_000, 777_777],
                4 => vec![rng.random()],
                5 => vec![1; rng.random_range(4..7)],
                _ => vec![1000; rng.random_range(1..20)],
            };
            for step in steps {
                clocks[clock] += i64::from(step);
                times.push(clocks[clock]);
            }
        }
        times
    }

    #[test]
    fn what_stands_between_the_times_comes_back() {
        let rng = &mut ChaCha8Rng::seed_from_u64(1);
        let mut records = Vec::new();
        for time in times(rng) {
            records.extend((0..POINT).map(|k| if k < 12 && k % 4 < 2 { rng.random() } else { 0 }));
            records.extend(time.to_le_bytes());
        }
        let items = LazItemRecordBuilder::default_for_point_format_id(1, 0).unwrap();
        assert_eq!((items[1].item_type(), items[1].version()), (::laz::LazItemType::GpsTime, 2));
        let mut coder = SequentialPointRecordCompressor::new(Cursor::new(Vec::new()));
        coder.set_fields_from(&items).unwrap();
        coder.compress_many(&records).unwrap();
        coder.done().unwrap();
        let coded = coder.into_inner().into_inner();

        let mut decoder = SequentialPointRecordDecompressor::new(Cursor::new(coded));
        decoder.set_fields_from(&items[..1].to_vec()).unwrap();
        decoder.add_field_decompressor(Skipped::default());
        let mut found = [0; RECORD];
        for (i, record) in records.chunks_exact(RECORD).enumerate() {
            decoder.decompress_next(&mut found).unwrap();
            assert_eq!(found[..POINT], record[..POINT], "point {i}");
        }
    }

    #[test]
    fn no_sequence_is_passed_by() {
        let coded = |symbols: &[u32]| {
            let mut model = ArithmeticModelBuilder::new(STILL_SYMBOLS).with_compression(true).build();
            let mut coder = ArithmeticEncoder::new(Cursor::new(Vec::new()));
            for &symbol in symbols {
                coder.encode_symbol(&mut model, symbol).unwrap();
            }
            coder.done().unwrap();
            coder.into_inner().into_inner()
        };
        let read = |symbols: &[u32]| {
            let mut decoder = ArithmeticDecoder::new(Cursor::new(coded(symbols)));
            decoder.read_init_bytes().unwrap();
            Skipped::default().decompress_with(&mut decoder, &mut [0; 8])
        };
        assert!(read(&[STARTS + 1, STILL]).is_ok());
        assert_eq!(read(&[STARTS + 1, STARTS + 2]).unwrap_err().kind(), ErrorKind::InvalidData);
    }
}
