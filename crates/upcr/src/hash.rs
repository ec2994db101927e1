//! Bytes as a number.

/// The 64-bit Fowler–Noll–Vo hash (1a), of eight bytes at a time.
pub(crate) fn fnv1a(bytes: &[u8]) -> u64 {
    let (words, rest) = bytes.as_chunks::<8>();
    let words = words.iter().map(|&word| u64::from_le_bytes(word)).chain(rest.iter().map(|&b| u64::from(b)));
    words.fold(0xcbf2_9ce4_8422_2325, |hash, word| (hash ^ word).wrapping_mul(0x0000_0100_0000_01b3))
}
