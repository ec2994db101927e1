//! The number types of binary formats.

/// Byte order of a binary file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ByteOrder {
    Little,
    Big,
}

/// A number type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
}

impl Scalar {
    /// From its kind (`I`, `U` or `F`) and its size in bytes.
    pub(super) fn from_kind(kind: char, size: usize) -> Option<Self> {
        Some(match (kind.to_ascii_uppercase(), size) {
            ('I', 1) => Self::I8,
            ('U', 1) => Self::U8,
            ('I', 2) => Self::I16,
            ('U', 2) => Self::U16,
            ('I', 4) => Self::I32,
            ('U', 4) => Self::U32,
            ('I', 8) => Self::I64,
            ('U', 8) => Self::U64,
            ('F', 4) => Self::F32,
            ('F', 8) => Self::F64,
            _ => return None,
        })
    }

    /// Size in bytes.
    pub(super) fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }

    /// What a colour channel of this type is multiplied with to run from 0 to 255.
    pub(super) fn color_scale(self) -> f64 {
        match self {
            Self::F32 | Self::F64 => 255.0,
            Self::U16 | Self::I16 => 1.0 / 257.0,
            _ => 1.0,
        }
    }

    /// The number at the start of `bytes`, which are at least `self.size()`.
    #[inline]
    pub(super) fn decode(self, bytes: &[u8], order: ByteOrder) -> f64 {
        macro_rules! decode {
            ($t:ty) => {{
                let mut raw = [0; size_of::<$t>()];
                raw.copy_from_slice(&bytes[..size_of::<$t>()]);
                (match order {
                    ByteOrder::Little => <$t>::from_le_bytes(raw),
                    ByteOrder::Big => <$t>::from_be_bytes(raw),
                }) as f64
            }};
        }
        match self {
            Self::I8 => decode!(i8),
            Self::U8 => decode!(u8),
            Self::I16 => decode!(i16),
            Self::U16 => decode!(u16),
            Self::I32 => decode!(i32),
            Self::U32 => decode!(u32),
            Self::I64 => decode!(i64),
            Self::U64 => decode!(u64),
            Self::F32 => decode!(f32),
            Self::F64 => decode!(f64),
        }
    }
}

/// Whether every coordinate is an `f32`, so that four bytes hold it.
pub(super) fn fits_f32(points: &[[f64; 3]]) -> bool {
    points.iter().flatten().all(|&v| f64::from(v as f32).to_bits() == v.to_bits() || v.is_nan())
}
