//! ModelNet40 as `modelnet40_ply_hdf5_2048`: HDF5 files of sampled shapes, listed in text files, and whatever is laid
//! out the same way.

use std::path::Path;

use upcr::{CloudRole, Error, Result};

use super::hdf5::Hdf5;
use super::{DataSet, Shapes, Split};

pub(super) const DATA_SET: DataSet = DataSet {
    what: "a folder like modelnet40_ply_hdf5_2048 (train_files.txt, test_files.txt)",
    recognise: |path| LISTS.iter().any(|list| path.join(list).is_file()),
    read,
};

/// The files that list those of either split. Of each entry the file's name alone counts: the folders before it are
/// those of the machine on which the list was made.
const LISTS: [&str; 2] = ["train_files.txt", "test_files.txt"];
/// Categories' names, one a line, in the order of their indices.
const NAMES: &str = "shape_names.txt";

fn read(folder: &Path, split: Split) -> Result<Shapes> {
    let mut shapes = Shapes { names: lines(&folder.join(NAMES))?, ..Shapes::default() };
    for list in split.of(LISTS) {
        for entry in lines(&folder.join(list))? {
            let name = entry.rsplit(['/', '\\']).next().unwrap_or_default();
            read_file(&folder.join(name), &mut shapes)?;
        }
    }
    Ok(shapes)
}

/// Appends the shapes of one file.
fn read_file(path: &Path, shapes: &mut Shapes) -> Result<()> {
    let file = Hdf5::open(path)?;
    let (data, labels) = (file.dataset("data")?, file.dataset("label")?);
    let malformed = |reason| Err(Error::Malformed { path: path.to_owned(), format: "HDF5", reason });
    let &[count, points, 3] = &data.shape[..] else {
        return malformed(format!("`data` has shape {:?}, not shapes × points × 3", data.shape));
    };
    if labels.values.len() != count {
        return malformed(format!("{} labels of {count} shapes", labels.values.len()));
    }
    let categories = shapes.names.len().min(1 << u8::BITS);
    if let Some(label) = labels.values.iter().find(|&&l| !(0.0..categories as f32).contains(&l)) {
        return malformed(format!("the label {label}, but {NAMES} has {} names", shapes.names.len()));
    }
    let (coordinates, _) = data.values.as_chunks::<3>();
    if let Some(first) = coordinates.iter().position(|p| p.iter().any(|v| !v.is_finite())) {
        let (shape, point) = (first / points, first % points);
        return malformed(format!("point {point} of shape {shape} is not finite"));
    }
    if points == 0 {
        return Err(Error::TooFewPoints { role: CloudRole::Cloud, found: 0, needed: 1 });
    }
    shapes.clouds.extend(coordinates.chunks_exact(points).map(<[_]>::to_vec));
    shapes.labels.extend(labels.values.iter().map(|&label| label as u8));
    Ok(())
}

/// The lines of a text file that are not blank.
fn lines(path: &Path) -> Result<Vec<String>> {
    match std::fs::read_to_string(path) {
        Ok(text) => Ok(text.lines().map(str::trim).filter(|l| !l.is_empty()).map(str::to_owned).collect()),
        Err(source) => Err(Error::Io { path: path.to_owned(), source }),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::data::{self, tests::published};

    #[test]
    fn lists_name_files_of_the_same_folder() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        // Seven shapes of five points, labelled 0 to 6; element i of the data is i / 4 - 3.
        let file = include_bytes!("../../tests/hdf5/earliest.h5");
        for name in ["ply_data_train0.h5", "ply_data_train1.h5", "ply_data_test0.h5"] {
            fs::write(at(name), file).unwrap();
        }
        fs::write(at(LISTS[0]), "data/elsewhere/ply_data_train0.h5\nply_data_train1.h5\n").unwrap();
        fs::write(at(LISTS[1]), "data/elsewhere/ply_data_test0.h5\n").unwrap();
        fs::write(at(NAMES), "a\nb\nc\nd\ne\nf\ng\n").unwrap();

        let train = data::open(folder.path(), Split::Train).unwrap();
        assert_eq!(train.labels, [0, 1, 2, 3, 4, 5, 6].repeat(2));
        assert_eq!(train.clouds[8].len(), 5);
        assert_eq!(train.clouds[8][1], [18.0, 19.0, 20.0].map(|i| i / 4.0 - 3.0));
        assert_eq!(train.names.len(), 7);
        assert_eq!(data::open(folder.path(), Split::Test).unwrap().len(), 7);
        assert_eq!(data::open(folder.path(), Split::All).unwrap().len(), 21);

        fs::write(at(NAMES), "a\n").unwrap();
        let error = data::open(folder.path(), Split::Test).unwrap_err().to_string();
        assert!(error.contains("ply_data_test0.h5") && error.contains("label 1"), "{error}");
        fs::remove_file(at("ply_data_test0.h5")).unwrap();
        assert!(matches!(data::open(folder.path(), Split::Test), Err(Error::Io { .. })));
    }

    #[test]
    fn published_shapes() {
        let Some(folder) = published("shapes69") else { return };
        for (split, count) in [(Split::Train, 1883), (Split::Test, 469)] {
            let shapes = data::open(&folder, split).unwrap();
            assert_eq!((shapes.len(), shapes.labels.len(), shapes.names.len()), (count, count, 69));
            for cloud in &shapes.clouds {
                assert_eq!(cloud.len(), 2048);
                let farthest = cloud.iter().map(|p| p.iter().map(|v| v * v).sum::<f32>()).fold(0.0, f32::max);
                assert!((farthest - 1.0).abs() < 1e-3, "{farthest}");
            }
        }
    }
}
