//! Where the lab's clouds come from: data sets of shapes, registration protocols over them, and a virtual scanner.

mod folder;
mod hdf5;
pub mod loader;
mod modelnet10;
mod modelnet40;
mod normalize;
mod npz;
mod number;
pub mod pairs;
pub mod scanner;
pub mod seven_scenes;

use std::ops::Range;
use std::path::Path;

use upcr::{Error, Result};

/// Clouds of a data set, each with the index of its category.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Shapes {
    /// Points in random order, so that leading ones are a sample of the whole; in the unit sphere or cube.
    pub clouds: Vec<Vec<[f32; 3]>>,
    /// Each cloud's category, an index into `names`.
    pub labels: Vec<u8>,
    /// Names of the categories.
    pub names: Vec<String>,
}

/// Which part of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Split {
    /// What training may see.
    Train,
    /// What it may not.
    Test,
    /// Both, first the former.
    All,
}

/// Half of a data set's categories; of an odd number the second has one more.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Half {
    /// Those with the lower indices.
    First,
    /// Those with the higher ones.
    Second,
}

/// A kind of data set.
struct DataSet {
    /// What it looks like on disk, for messages.
    what: &'static str,
    /// Whether a path is one.
    recognise: fn(&Path) -> bool,
    read: fn(&Path, Split) -> Result<Shapes>,
}

/// Every kind there is; the first that recognises a path reads it. A new one is a file of its own and a line here.
static DATA_SETS: &[DataSet] =
    &[modelnet40::DATA_SET, modelnet10::DATA_SET, seven_scenes::DATA_SET, folder::DATA_SET];

/// Reads a data set, whose kind is told by what is at `path`.
///
/// # Errors
/// [`Error::Unsupported`] where nothing known is there or the split is empty; else as the files' readers say.
pub fn open(path: impl AsRef<Path>, split: Split) -> Result<Shapes> {
    let path = path.as_ref();
    let unsupported = |reason| Err(Error::Unsupported { path: path.to_owned(), reason });
    if let Err(source) = path.metadata() {
        return Err(Error::Io { path: path.to_owned(), source });
    }
    let Some(data_set) = DATA_SETS.iter().find(|set| (set.recognise)(path)) else {
        let known: Vec<_> = DATA_SETS.iter().map(|set| set.what).collect();
        return unsupported(format!("no known data set; known are {}", known.join("; ")));
    };
    let shapes = (data_set.read)(path, split)?;
    if shapes.is_empty() {
        return unsupported(format!("the data set has no shapes in its split {split:?}"));
    }
    Ok(shapes)
}

/// The part `index` of so many consecutive parts of `length` things, as even as it goes.
///
/// ```
/// assert_eq!(upcr_lab::data::share(7, 1, 3), 2..4);
/// ```
pub fn share(length: usize, index: usize, parts: usize) -> Range<usize> {
    index * length / parts..(index + 1) * length / parts
}

impl Shapes {
    /// Number of shapes.
    pub fn len(&self) -> usize {
        self.clouds.len()
    }

    /// Whether there is no shape.
    pub fn is_empty(&self) -> bool {
        self.clouds.is_empty()
    }

    /// The points of the shape `index`.
    ///
    /// # Panics
    /// Where `index` is not below [`Self::len`].
    pub fn points(&self, index: usize) -> Vec<[f64; 3]> {
        self.clouds[index].iter().map(|p| p.map(f64::from)).collect()
    }

    /// Keeps the first `length` shapes.
    pub fn truncate(&mut self, length: usize) {
        self.clouds.truncate(length);
        self.labels.truncate(length);
    }

    /// Adds the shapes of another set, whose categories come after these.
    pub fn append(&mut self, other: Self) {
        let first = self.names.len() as u8;
        self.clouds.extend(other.clouds);
        self.labels.extend(other.labels.iter().map(|label| first.wrapping_add(*label)));
        self.names.extend(other.names);
    }

    /// Two sets: all but every `nth` shape, and these.
    pub fn split_every_nth(&self, nth: usize) -> (Self, Self) {
        let part = |held_out: bool| {
            let kept = |index: &usize| (index % nth == nth - 1) == held_out;
            let indices: Vec<usize> = (0..self.len()).filter(kept).collect();
            Self {
                clouds: indices.iter().map(|&i| self.clouds[i].clone()).collect(),
                labels: indices.iter().map(|&i| self.labels[i]).collect(),
                names: self.names.clone(),
            }
        };
        (part(false), part(true))
    }

    /// Takes the shapes from `length` on, where there are any, into a set of their own.
    #[must_use]
    pub fn split_off(&mut self, length: usize) -> Self {
        let length = length.min(self.len());
        Self {
            clouds: self.clouds.split_off(length),
            labels: self.labels.split_off(length),
            names: self.names.clone(),
        }
    }

    /// So many sets of consecutive shapes, as even as it goes.
    pub fn in_parts(mut self, parts: usize) -> Vec<Self> {
        let length = self.len();
        let part = |index| {
            let later = self.split_off(share(length, index, parts).len());
            std::mem::replace(&mut self, later)
        };
        (0..parts).map(part).collect()
    }

    /// The shapes of half of the categories: those of the one are unseen to who has trained on the other.
    #[must_use]
    pub fn categories(self, half: Half) -> Self {
        let middle = self.names.len() / 2;
        let kept = |label: u8| (usize::from(label) < middle) == (half == Half::First);
        let (clouds, labels) =
            self.clouds.into_iter().zip(self.labels).filter(|&(_, label)| kept(label)).unzip();
        Self { clouds, labels, ..self }
    }
}

impl Split {
    /// Those of the parts [train, test] that belong to it.
    fn of<T>(self, [train, test]: [T; 2]) -> Vec<T> {
        match self {
            Self::Train => vec![train],
            Self::Test => vec![test],
            Self::All => vec![train, test],
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::path::PathBuf;

    use super::*;

    /// A public data set by its name; where it is absent, says so.
    pub(super) fn published(name: &str) -> Option<PathBuf> {
        let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
        let root = std::env::var_os("UPCR_DATA").filter(|v| !v.is_empty()).map_or(beside, PathBuf::from);
        let path = root.join(name);
        if path.exists() {
            return Some(path);
        }
        // Past the test harness, which keeps passing tests' output to itself.
        let line =
            format!("skipped: {name} is absent (looked for at {}; UPCR_DATA tells where)\n", path.display());
        std::io::stderr().write_all(line.as_bytes()).unwrap();
        None
    }

    #[test]
    fn categories_are_halved_by_their_index() {
        let shapes = Shapes {
            clouds: (0..6).map(|i| vec![[i as f32; 3]]).collect(),
            labels: vec![4, 0, 1, 2, 1, 3],
            names: ["a", "b", "c", "d", "e"].map(str::to_owned).to_vec(),
        };
        let (first, second) =
            (shapes.clone().categories(Half::First), shapes.clone().categories(Half::Second));
        assert_eq!((first.labels, second.labels), (vec![0, 1, 1], vec![4, 2, 3]));
        assert_eq!(first.clouds, [1, 2, 4].map(|i| shapes.clouds[i].clone()));
        assert_eq!(second.names, shapes.names);
    }

    #[test]
    fn what_is_no_data_set_is_refused() {
        let here = Path::new(env!("CARGO_MANIFEST_DIR"));
        assert!(matches!(open(here.join("src"), Split::Train), Err(Error::Unsupported { .. })));
        assert!(matches!(open(here.join("nowhere"), Split::Train), Err(Error::Io { .. })));
    }
}
