//! Numbers as binary files store them.

/// How a number is stored.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Number {
    pub(super) kind: Kind,
    /// 1, 2, 4 or 8 bytes; of floats 4 or 8.
    pub(super) size: usize,
    pub(super) big_endian: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Kind {
    Unsigned,
    Signed,
    Float,
}

impl Number {
    /// From `self.size` bytes, rounded to single precision.
    pub(super) fn decode(self, bytes: &[u8]) -> f32 {
        let join = |value: u64, &byte: &u8| value << 8 | u64::from(byte);
        let bits =
            if self.big_endian { bytes.iter().fold(0, join) } else { bytes.iter().rev().fold(0, join) };
        let unused = 64 - 8 * self.size as u32;
        match (self.kind, self.size) {
            (Kind::Float, 4) => f32::from_bits(bits as u32),
            (Kind::Float, _) => f64::from_bits(bits) as f32,
            (Kind::Signed, _) => ((bits << unused) as i64 >> unused) as f32,
            (Kind::Unsigned, _) => bits as f32,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_those_of_their_bytes() {
        use Kind::{Float, Signed, Unsigned};
        for (kind, big_endian, bytes, expected) in [
            (Signed, true, &[0xff, 0xfe][..], -2.0),
            (Unsigned, false, &[0xff, 0xfe], 65_279.0),
            (Unsigned, false, &[7], 7.0),
            (Signed, false, &(-5_i64).to_le_bytes(), -5.0),
            (Float, false, &0.25_f32.to_le_bytes(), 0.25),
            (Float, true, &(-1.5_f64).to_be_bytes(), -1.5),
        ] {
            assert_eq!(Number { kind, size: bytes.len(), big_endian }.decode(bytes), expected);
        }
    }
}
