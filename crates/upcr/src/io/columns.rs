//! From rows of named numbers to a cloud: which column is which.

use crate::PointCloud;

use super::scalar::Scalar;

/// Where a row keeps its colour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Color {
    /// Three columns, and what they are multiplied with to run from 0 to 255.
    Channels { columns: [usize; 3], scale: f64 },
    /// One column that holds `0x00RRGGBB`, as the bits of a float where `float`.
    Packed { column: usize, float: bool },
}

/// Which columns of a row make a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Columns {
    pub(super) position: [usize; 3],
    pub(super) normal: Option<[usize; 3]>,
    pub(super) color: Option<Color>,
}

impl Columns {
    /// Positions only.
    pub(super) fn position(columns: [usize; 3]) -> Self {
        Self { position: columns, normal: None, color: None }
    }

    /// Told by the columns' names, in the spellings of all formats; `None` where x, y or z is missing.
    pub(super) fn by_name(fields: &[(&str, Scalar)]) -> Option<Self> {
        let find = |names: &[&str]| {
            fields.iter().position(|(name, _)| names.iter().any(|n| n.eq_ignore_ascii_case(name)))
        };
        let triple = |names: [&[&str]; 3]| Some([find(names[0])?, find(names[1])?, find(names[2])?]);
        let channels = triple([
            &["red", "r", "diffuse_red"],
            &["green", "g", "diffuse_green"],
            &["blue", "b", "diffuse_blue"],
        ])
        .map(|columns| Color::Channels { columns, scale: fields[columns[0]].1.color_scale() });
        let packed = || {
            let column = find(&["rgb", "rgba"]).filter(|&c| fields[c].1.size() == 4)?;
            Some(Color::Packed { column, float: fields[column].1 == Scalar::F32 })
        };
        Some(Self {
            position: triple([&["x"], &["y"], &["z"]])?,
            normal: triple([&["nx", "normal_x"], &["ny", "normal_y"], &["nz", "normal_z"]]),
            color: channels.or_else(packed),
        })
    }

    /// The largest column that is used.
    pub(super) fn last(&self) -> usize {
        let color = match self.color {
            Some(Color::Channels { columns, .. }) => columns.into_iter().max(),
            Some(Color::Packed { column, .. }) => Some(column),
            None => None,
        };
        self.position.into_iter().chain(self.normal.into_iter().flatten()).chain(color).max().unwrap_or(0)
    }
}

/// A cloud growing row by row.
pub(super) struct Builder {
    columns: Columns,
    points: Vec<[f64; 3]>,
    normals: Vec<[f32; 3]>,
    colors: Vec<[u8; 3]>,
}

impl Builder {
    /// For `capacity` rows, a number that has been checked against the file's size.
    pub(super) fn new(columns: Columns, capacity: u64) -> Self {
        let capacity = capacity as usize;
        Self {
            columns,
            points: Vec::with_capacity(capacity),
            normals: Vec::with_capacity(if columns.normal.is_some() { capacity } else { 0 }),
            colors: Vec::with_capacity(if columns.color.is_some() { capacity } else { 0 }),
        }
    }

    /// Adds the row whose column `c` is `at(c)`.
    #[inline]
    pub(super) fn push(&mut self, at: impl Fn(usize) -> f64) {
        self.points.push(self.columns.position.map(&at));
        if let Some(normal) = self.columns.normal {
            self.normals.push(normal.map(|c| at(c) as f32));
        }
        match self.columns.color {
            Some(Color::Channels { columns, scale }) => {
                // A float-to-integer cast saturates, which is what an out-of-range colour needs.
                self.colors.push(columns.map(|c| (at(c) * scale).round() as u8));
            }
            Some(Color::Packed { column, float }) => {
                let bits = if float { (at(column) as f32).to_bits() } else { at(column) as i64 as u32 };
                let [_, r, g, b] = bits.to_be_bytes();
                self.colors.push([r, g, b]);
            }
            None => {}
        }
    }

    /// The cloud.
    pub(super) fn finish(self) -> PointCloud {
        PointCloud {
            points: self.points,
            normals: self.columns.normal.map(|_| self.normals),
            colors: self.columns.color.map(|_| self.colors),
            viewpoint: None,
        }
    }
}
