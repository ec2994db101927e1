//! 7-Scenes: depth images of rooms with the cameras' poses, as `frame-000000.depth.png` and `frame-000000.pose.txt`.
//!
//! A path is a folder of frames, a scene with a folder for each sequence, or a folder of scenes. `TrainSplit.txt` and
//! `TestSplit.txt` of a scene say which sequences are which; without them the last fifth of each sequence is for tests.
//! As [`super::open`] reads them, frames become shapes in the unit cube, for motions that are made up, and scenes are
//! the categories; [`frame_pairs`] gives two frames with their true motion, in metres.

use std::path::{Path, PathBuf};

use rayon::prelude::*;
use upcr::io::{Intrinsics, ReadOptions, read_cloud_with, read_transform};
use upcr::{Error, PointCloud, Result, Rigid};

use super::normalize::{sample, unit_cube};
use super::pairs::Pair;
use super::{DataSet, Shapes, Split};
use crate::random;

pub(super) const DATA_SET: DataSet = DataSet {
    what: "7-Scenes (a folder of frame-*.depth.png, a scene or several)",
    recognise: |path| scenes(path).is_ok_and(|scenes| !scenes.is_empty()),
    read,
};

/// A depth image and where it was taken.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Index of the scene.
    pub scene: usize,
    /// Index of the sequence, over all scenes.
    pub sequence: usize,
    /// Number in the sequence.
    pub number: u64,
    /// The depth image, in millimetres.
    pub depth: PathBuf,
    /// Pose of the camera.
    pub T_world_camera: Rigid,
    /// The camera; `None` for the Kinect that 7-Scenes was taken with.
    pub intrinsics: Option<Intrinsics>,
}

impl Frame {
    /// The cloud in the camera's frame, in metres: x right, y down, z ahead.
    ///
    /// # Errors
    /// As [`read_cloud_with`].
    pub fn cloud(&self) -> Result<PointCloud> {
        read_cloud_with(&self.depth, &ReadOptions { intrinsics: self.intrinsics, ..ReadOptions::default() })
    }
}

/// The frames of a split, ordered by sequence and number, and the names of the scenes.
///
/// # Errors
/// Where folders or poses cannot be read.
pub fn frames(path: &Path, split: Split) -> Result<(Vec<Frame>, Vec<String>)> {
    let scenes = scenes(path)?;
    let mut frames = Vec::new();
    let mut sequences = 0;
    for (scene, Scene { folder, sequences: folders }) in scenes.iter().enumerate() {
        let lists = [Split::Train, Split::Test].map(|split| split_list(folder, split));
        for sequence in folders {
            let mut found = frames_of(sequence, folder, scene, sequences)?;
            sequences += 1;
            match (split, &lists) {
                (Split::All, _) => {}
                (_, [Some(train), Some(test)]) => {
                    let list = if split == Split::Train { train } else { test };
                    if sequence_number(sequence).is_none_or(|number| !list.contains(&number)) {
                        found.clear();
                    }
                }
                (Split::Train, _) => found.truncate(found.len() - found.len() / 5),
                (Split::Test, _) => drop(found.drain(..found.len() - found.len() / 5)),
            }
            frames.append(&mut found);
        }
    }
    Ok((frames, scenes.into_iter().map(|scene| name(&scene.folder)).collect()))
}

/// Pairs of frames of one sequence whose numbers are `gap` apart, the first of each being the source.
pub fn frame_pairs(frames: &[Frame], gap: u64) -> Vec<[&Frame; 2]> {
    let key = |frame: &Frame| (frame.sequence, frame.number);
    let later = |source: &Frame| {
        let at = frames.binary_search_by_key(&(source.sequence, source.number + gap), key).ok()?;
        Some(&frames[at])
    };
    frames.iter().filter_map(|source| Some([source, later(source)?])).collect()
}

/// The clouds of two frames and the true motion between them.
///
/// # Errors
/// As [`Frame::cloud`].
pub fn read_pair([source, target]: [&Frame; 2]) -> Result<Pair> {
    let T_target_source = target.T_world_camera.inverse() * source.T_world_camera;
    Ok(Pair { source: source.cloud()?, target: target.cloud()?, T_target_source })
}

fn read(path: &Path, split: Split) -> Result<Shapes> {
    let (frames, names) = frames(path, split)?;
    let clouds = frames.par_iter().map(shape).collect::<Result<_>>()?;
    Ok(Shapes { clouds, labels: frames.iter().map(|frame| frame.scene as u8).collect(), names })
}

fn shape(frame: &Frame) -> Result<Vec<[f32; 3]>> {
    let seed = random::fnv1a(&format!("7-Scenes sequence {}", frame.sequence));
    let cloud = sample(frame.cloud()?, &mut random::stream(seed, frame.number));
    unit_cube(&cloud)
        .map_err(|error| Error::Unsupported { path: frame.depth.clone(), reason: error.to_string() })
}

/// A scene and the folders of its sequences.
struct Scene {
    folder: PathBuf,
    sequences: Vec<PathBuf>,
}

/// The scenes at `path`, by name; none where there are no frames.
fn scenes(path: &Path) -> Result<Vec<Scene>> {
    let one = |folder: &Path| -> Result<Option<Scene>> {
        let mut sequences = vec![folder.to_owned()];
        sequences.extend(entries(folder)?.into_iter().filter(|entry| sequence_number(entry).is_some()));
        let mut kept = Vec::new();
        for sequence in sequences {
            if entries(&sequence)?.iter().any(|file| frame_number(file).is_some()) {
                kept.push(sequence);
            }
        }
        Ok((!kept.is_empty()).then(|| Scene { folder: folder.to_owned(), sequences: kept }))
    };
    if let Some(scene) = one(path)? {
        return Ok(vec![scene]);
    }
    let folders = entries(path)?.into_iter().filter(|entry| entry.is_dir());
    let scenes: Vec<Scene> = folders.filter_map(|folder| one(&folder).transpose()).collect::<Result<_>>()?;
    if scenes.len() > 1 << u8::BITS {
        let reason = format!("{} scenes, where 256 can be told apart", scenes.len());
        return Err(Error::Unsupported { path: path.to_owned(), reason });
    }
    Ok(scenes)
}

/// All frames of a sequence's folder, by number.
fn frames_of(folder: &Path, scene_folder: &Path, scene: usize, sequence: usize) -> Result<Vec<Frame>> {
    let beside = |folder: &Path| Some(folder.join("camera-intrinsics.txt")).filter(|path| path.is_file());
    let intrinsics = match beside(folder).or_else(|| beside(scene_folder)) {
        Some(path) => Some(read_intrinsics(&path)?),
        None => None,
    };
    let images = entries(folder)?.into_iter().filter_map(|path| Some((frame_number(&path)?, path)));
    let mut frames = images
        .map(|(number, depth)| {
            let T_world_camera = read_transform(depth.with_extension("").with_extension("pose.txt"))?;
            Ok(Frame { scene, sequence, number, depth, T_world_camera, intrinsics })
        })
        .collect::<Result<Vec<_>>>()?;
    frames.sort_by_key(|frame| frame.number);
    Ok(frames)
}

/// A 3×3 camera matrix, row after row.
fn read_intrinsics(path: &Path) -> Result<Intrinsics> {
    let text = std::fs::read_to_string(path).map_err(|source| Error::Io { path: path.to_owned(), source })?;
    let numbers: Option<Vec<f64>> = text.split_whitespace().map(|word| word.parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[fx, _, cx, _, fy, cy, _, _, _]) if fx > 0.0 && fy > 0.0 => Ok(Intrinsics { fx, fy, cx, cy }),
        _ => Err(Error::Malformed {
            path: path.to_owned(),
            format: "camera intrinsics",
            reason: "9 numbers of a 3×3 camera matrix are needed, with positive focal lengths".into(),
        }),
    }
}

/// The numbers of the sequences that a scene's list names (`sequence1`, one a line); `None` where it has no list.
fn split_list(scene: &Path, split: Split) -> Option<Vec<u64>> {
    let text = std::fs::read_to_string(scene.join(format!("{split:?}Split.txt"))).ok()?;
    Some(text.lines().filter_map(|line| line.trim().strip_prefix("sequence")?.parse().ok()).collect())
}

/// Of `seq-01`, 1.
fn sequence_number(folder: &Path) -> Option<u64> {
    folder.file_name()?.to_str()?.strip_prefix("seq-")?.parse().ok()
}

/// Of `frame-000012.depth.png`, 12.
fn frame_number(file: &Path) -> Option<u64> {
    file.file_name()?.to_str()?.strip_prefix("frame-")?.strip_suffix(".depth.png")?.parse().ok()
}

fn name(folder: &Path) -> String {
    folder.file_name().map_or_else(|| "scene".into(), |name| name.to_string_lossy().into_owned())
}

/// What is in a folder, by name.
fn entries(folder: &Path) -> Result<Vec<PathBuf>> {
    let list = || -> std::io::Result<Vec<PathBuf>> {
        let mut paths =
            folder.read_dir()?.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>()?;
        paths.sort();
        Ok(paths)
    };
    list().map_err(|source| Error::Io { path: folder.to_owned(), source })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::data;
    use crate::data::tests::published;

    /// A scene of frames 0 to 9 in each of `sequences`; frame n's camera stands at x = n.
    fn make_scene(folder: &Path, sequences: &[&str]) {
        let image = include_bytes!("../../tests/seven_scenes/depth.png");
        for sequence in sequences {
            let folder = folder.join(sequence);
            fs::create_dir_all(&folder).unwrap();
            for n in 0..10 {
                fs::write(folder.join(format!("frame-{n:06}.depth.png")), image).unwrap();
                let pose = format!("1 0 0 {n}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n");
                fs::write(folder.join(format!("frame-{n:06}.pose.txt")), pose).unwrap();
            }
            fs::write(folder.join("camera-intrinsics.txt"), "4 0 3.5\n0 4 2.5\n0 0 1\n").unwrap();
        }
    }

    fn numbers(path: &Path, split: Split) -> Vec<(usize, usize, u64)> {
        let (frames, _) = frames(path, split).unwrap();
        frames.iter().map(|f| (f.scene, f.sequence, f.number)).collect()
    }

    #[test]
    fn folders_scenes_and_collections_are_told_apart() {
        let root = tempfile::tempdir().unwrap();
        make_scene(&root.path().join("chess"), &["seq-01", "seq-02"]);
        make_scene(&root.path().join("fire"), &[""]);
        fs::create_dir(root.path().join("empty")).unwrap();
        let [chess, fire] = ["chess", "fire"].map(|name| root.path().join(name));

        assert_eq!(numbers(&fire, Split::Train), (0..8).map(|n| (0, 0, n)).collect::<Vec<_>>());
        assert_eq!(numbers(&chess, Split::Test), [(0, 0, 8), (0, 0, 9), (0, 1, 8), (0, 1, 9)]);
        fs::write(chess.join("TrainSplit.txt"), "sequence2\r\n").unwrap();
        fs::write(chess.join("TestSplit.txt"), "sequence1\r\n").unwrap();
        assert_eq!(numbers(&chess, Split::Train), (0..10).map(|n| (0, 1, n)).collect::<Vec<_>>());
        assert_eq!(numbers(&chess, Split::Test), (0..10).map(|n| (0, 0, n)).collect::<Vec<_>>());

        let all = data::open(root.path(), Split::All).unwrap();
        assert_eq!(all.names, ["chess", "fire"]);
        assert_eq!(all.labels, [vec![0; 20], vec![1; 10]].concat());

        fs::remove_file(chess.join("seq-01/frame-000003.pose.txt")).unwrap();
        assert!(matches!(data::open(&chess, Split::All), Err(Error::Io { .. })));
        fs::write(fire.join("camera-intrinsics.txt"), "585").unwrap();
        assert!(matches!(data::open(&fire, Split::All), Err(Error::Malformed { .. })));
    }

    #[test]
    fn pairs_have_the_motion_between_their_cameras() {
        let root = tempfile::tempdir().unwrap();
        make_scene(root.path(), &["seq-01", "seq-02"]);
        let (frames, _) = frames(root.path(), Split::All).unwrap();
        let pairs = frame_pairs(&frames, 4);
        assert_eq!(pairs.len(), 12);
        for frames in pairs {
            assert_eq!((frames[0].sequence, frames[0].number + 4), (frames[1].sequence, frames[1].number));
            let pair = read_pair(frames).unwrap();
            // What stands still lies farther left when seen from farther right.
            assert_eq!(pair.T_target_source, Rigid::from_translation([-4.0, 0.0, 0.0]));
            // 8 × 6 pixels, the first without depth; the last, (7, 5), is 1.048 m away.
            assert_eq!(pair.source.len(), 47);
            let last = pair.source.points[46];
            let expected = [3.5, 2.5, 4.0].map(|v| 1.048 * v / 4.0);
            assert!(last.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{last:?}");
        }
    }

    #[test]
    fn published_frames() {
        let Some(folder) = published("redkitchen") else { return };
        let (frames, names) = frames(&folder, Split::All).unwrap();
        assert_eq!((frames.len(), names), (250, vec!["redkitchen".to_owned()]));
        // Where the source is laid by the true motion, the target has a point within 2 cm of most of it.
        let pair = read_pair(frame_pairs(&frames, 20)[0]).unwrap();
        let tree = upcr::neighbors::KdTree::new(&single(&pair.target));
        let moved = single(&pair.source.transformed(&pair.T_target_source));
        let thinned: Vec<_> = moved.iter().step_by(50).collect();
        let near = thinned.iter().filter(|&&&p| tree.nearest(p, 4e-4).is_some()).count();
        assert!(near * 10 > thinned.len() * 7, "{near} of {}", thinned.len());

        let shapes = data::open(&folder, Split::Test).unwrap();
        assert_eq!(shapes.len(), 50);
        assert!(shapes.clouds.iter().all(|cloud| cloud.len() == 2048));
    }

    fn single(cloud: &PointCloud) -> Vec<[f32; 3]> {
        cloud.points.iter().map(|p| p.map(|v| v as f32)).collect()
    }
}
