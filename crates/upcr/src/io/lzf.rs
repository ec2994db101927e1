//! LZF, the compression inside `binary_compressed` PCD files.
//!
//! A control byte below 32 announces that many literal bytes and one more. Any other is a reference back: its
//! upper three bits are the length less 2 (7: the next byte adds to it), its lower five and one more byte the
//! distance less 1.

use super::input::{Fallible, malformed};

/// Most that a byte of input can become.
pub(super) const GREATEST_RATIO: u64 = 88;

const LONGEST_LITERAL: usize = 32;
const LONGEST_MATCH: usize = 264;
const LONGEST_DISTANCE: usize = 1 << 13;
const SHORTEST_MATCH: usize = 3;
const HASH_BITS: u32 = 16;

/// Decompresses `input` into exactly `size` bytes, which the caller has checked to be possible.
pub(super) fn decompress(input: &[u8], size: usize) -> Fallible<Vec<u8>> {
    let mut output = Vec::with_capacity(size);
    let mut bytes = input.iter().copied().map(usize::from);
    while let Some(control) = bytes.next() {
        if control < LONGEST_LITERAL {
            let at = input.len() - bytes.len();
            let Some(literal) = input.get(at..=at + control) else { break };
            output.extend_from_slice(literal);
            bytes.nth(control);
        } else {
            let mut length = (control >> 5) + 2;
            if length == 9 {
                let Some(more) = bytes.next() else { break };
                length += more;
            }
            let Some(low) = bytes.next() else { break };
            let distance = ((control & 31) << 8) + low + 1;
            let Some(start) = output.len().checked_sub(distance) else {
                return malformed("compressed data refer to before their start");
            };
            if output.len() + length > size {
                break;
            }
            // A reference may run into what it writes itself.
            for i in start..start + length {
                output.push(output[i]);
            }
        }
        if output.len() > size {
            break;
        }
    }
    if output.len() == size && bytes.len() == 0 {
        Ok(output)
    } else {
        malformed("compressed data do not decompress to the length they claim")
    }
}

/// Compresses `input`.
pub(super) fn compress(input: &[u8]) -> Vec<u8> {
    let mut output = Vec::with_capacity(input.len() / 2);
    // Where three bytes of this hash were last seen, from 1.
    let mut seen = vec![0usize; 1 << HASH_BITS];
    let (mut at, mut literal_start) = (0, 0);
    while at + SHORTEST_MATCH <= input.len() {
        let key = u32::from_be_bytes([0, input[at], input[at + 1], input[at + 2]]);
        let slot = &mut seen[(key.wrapping_mul(0x9E37_79B1) >> (32 - HASH_BITS)) as usize];
        let candidate = std::mem::replace(slot, at + 1);
        let start = candidate.wrapping_sub(1);
        let near = candidate > 0 && at - start <= LONGEST_DISTANCE;
        if !near || input[start..start + SHORTEST_MATCH] != input[at..at + SHORTEST_MATCH] {
            at += 1;
            continue;
        }
        let length =
            (input[at..].iter().zip(&input[start..])).take(LONGEST_MATCH).take_while(|(a, b)| a == b).count();
        push_literals(&mut output, &input[literal_start..at]);
        push_match(&mut output, at - start, length);
        at += length;
        literal_start = at;
    }
    push_literals(&mut output, &input[literal_start..]);
    output
}

fn push_literals(output: &mut Vec<u8>, literals: &[u8]) {
    for run in literals.chunks(LONGEST_LITERAL) {
        output.push(run.len() as u8 - 1);
        output.extend_from_slice(run);
    }
}

fn push_match(output: &mut Vec<u8>, distance: usize, length: usize) {
    let (distance, length) = (distance - 1, length - 2);
    let high = (distance >> 8) as u8;
    if length < 7 {
        output.push((length as u8) << 5 | high);
    } else {
        output.extend([7 << 5 | high, (length - 7) as u8]);
    }
    output.push(distance as u8);
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_run_shrinks_and_comes_back() {
        let data = vec![7; 10_000];
        let packed = compress(&data);
        assert!(packed.len() < 200);
        assert_eq!(decompress(&packed, data.len()).unwrap(), data);
    }

    #[test]
    fn a_hand_written_stream() {
        // Literal "abc", then five bytes from three back.
        assert_eq!(decompress(&[2, b'a', b'b', b'c', 3 << 5, 2], 8).unwrap(), b"abcabcab");
        assert!(decompress(&[3 << 5, 2], 5).is_err(), "refers to before the start");
        assert!(decompress(&[2, b'a'], 3).is_err(), "literal cut off");
    }

    proptest! {
        #[test]
        fn round_trips(data in prop::collection::vec(0u8..4, 0..2000)) {
            prop_assert_eq!(decompress(&compress(&data), data.len()).unwrap(), data);
        }
    }
}
