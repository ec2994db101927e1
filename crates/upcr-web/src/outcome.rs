//! Two files' bytes to a registration, and what can be had of it.

use std::io::Cursor;

use serde::Deserialize;
use upcr::io::{ReadOptions, WriteOptions, read_cloud_from, read_comments_from, write_cloud_to};
use upcr::{
    Method, PointCloud, Progress, Refinement, Registration, Result, Rigid, Settings, Watch, register_watched,
};
use upcr_report::{Contents, Page};

/// What the page lets its reader choose; the rest is the library's default.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Choices {
    /// Where the first pose comes from.
    pub method: Method,
    /// What the refinement minimises.
    pub refine: Refinement,
    /// In the clouds' unit; none: derived from them.
    pub voxel_size: Option<f64>,
    /// Seed of every random choice.
    pub seed: u64,
}

impl Choices {
    fn settings(&self) -> Settings {
        let &Self { method, refine, voxel_size, seed } = self;
        Settings { method, refine, voxel_size, seed, ..Settings::default() }
    }
}

/// A file as the page was given it.
#[derive(Debug, Clone, Copy)]
pub struct File<'a> {
    /// Its name, whose extension tells the format.
    pub name: &'a str,
    /// What is in it.
    pub bytes: &'a [u8],
}

impl File<'_> {
    fn read(self) -> Result<PointCloud> {
        read_cloud_from(self.name, Cursor::new(self.bytes), &ReadOptions::default())
    }

    fn comments(self) -> Result<Vec<String>> {
        read_comments_from(self.name, Cursor::new(self.bytes))
    }
}

/// Two scans, and how one lies on the other.
#[derive(Debug)]
pub struct Outcome {
    names: [String; 2],
    clouds: [PointCloud; 2],
    comments: [Vec<String>; 2],
    found: Registration,
}

impl Outcome {
    /// Reads both files and registers them.
    ///
    /// # Errors
    /// As [`read_cloud_from`] and [`register_watched`].
    pub fn new(
        source: File,
        target: File,
        choices: &Choices,
        progress: &(dyn Fn(Progress) + Sync),
    ) -> Result<Self> {
        let clouds = [source.read()?, target.read()?];
        let comments = [source.comments()?, target.comments()?];
        let watch = Watch { progress: Some(progress), ..Watch::default() };
        let found = register_watched(&clouds[0], &clouds[1], &choices.settings(), &watch)?;
        Ok(Self { names: [source.name, target.name].map(Into::into), clouds, comments, found })
    }

    fn page(&self) -> Page<'_> {
        let [source, target] = [0, 1].map(|i| (self.names[i].as_str(), &self.clouds[i]));
        Page::of_registration(source, target, &self.found).with_comments(&self.comments)
    }

    /// What the page shows.
    ///
    /// # Errors
    /// As [`Page::contents`].
    pub fn contents(&self) -> Result<Contents> {
        self.page().contents()
    }

    /// The report, as the command line writes it.
    ///
    /// # Errors
    /// As [`Page::html`].
    pub fn report(&self) -> Result<String> {
        self.page().html()
    }

    /// The source moved onto the target, as a file whose format `name` tells. Pose 0 is the one found, and after it come
    /// the alternatives; there being no such pose, nothing is moved.
    ///
    /// # Errors
    /// As [`write_cloud_to`].
    pub fn aligned(&self, pose: usize, name: &str) -> Result<Vec<u8>> {
        let others = self.found.alternatives.iter().map(|a| a.T_target_source);
        let poses = std::iter::once(self.found.T_target_source).chain(others);
        let pose = poses.into_iter().nth(pose).unwrap_or_else(Rigid::identity);
        let mut file = Cursor::new(Vec::new());
        write_cloud_to(name, &mut file, &self.clouds[0].transformed(&pose), &WriteOptions::default())?;
        Ok(file.into_inner())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use upcr::{Error, register};

    use super::*;

    const SOURCE: File = File { name: "source.ply", bytes: include_bytes!("../../../samples/source.ply") };
    const TARGET: File = File { name: "target.ply", bytes: include_bytes!("../../../samples/target.ply") };

    #[test]
    fn the_samples_register_as_in_the_library() {
        let told = Mutex::new(Vec::new());
        let hear = |p: Progress| told.lock().unwrap().push(p.done);
        let outcome = Outcome::new(SOURCE, TARGET, &Choices::default(), &hear).unwrap();
        let found = register(&SOURCE.read().unwrap(), &TARGET.read().unwrap(), &Settings::default()).unwrap();
        assert_eq!(outcome.found.T_target_source, found.T_target_source);
        assert_eq!(told.lock().unwrap().last(), Some(&1.0));

        let words: serde_json::Value = serde_json::from_str(&outcome.contents().unwrap().words).unwrap();
        assert_eq!(words["clouds"][1]["name"], "target.ply");
        assert!(outcome.report().unwrap().contains("<!doctype html>"));
        let bytes = outcome.aligned(0, "aligned.ply").unwrap();
        let back = File { name: "aligned.ply", bytes: &bytes }.read().unwrap();
        let moved = outcome.clouds[0].transformed(&found.T_target_source);
        assert!(
            back.points.iter().zip(&moved.points).all(|(a, b)| (0..3).all(|k| (a[k] - b[k]).abs() < 1e-6))
        );
    }

    #[test]
    fn what_cannot_be_read_or_written_is_told() {
        let hear = |_| ();
        let broken = File { name: "broken.ply", bytes: b"ply\nnonsense" };
        let refused = |a, b| Outcome::new(a, b, &Choices::default(), &hear).unwrap_err();
        assert!(matches!(refused(broken, TARGET), Error::Malformed { .. }));
        assert!(matches!(refused(SOURCE, File { name: "a.docx", ..TARGET }), Error::Unsupported { .. }));
        let outcome = Outcome::new(SOURCE, TARGET, &Choices::default(), &hear).unwrap();
        assert!(outcome.aligned(0, "aligned.docx").is_err());
    }

    #[test]
    fn choices_are_json() {
        let read = |text| serde_json::from_str::<Choices>(text).map(|c| c.settings());
        assert_eq!(read("{}").unwrap(), Settings::default());
        let told = read(r#"{"method":"features","refine":"plane","voxel_size":0.5,"seed":3}"#).unwrap();
        assert_eq!((told.method, told.voxel_size, told.seed), (Method::Features, Some(0.5), 3));
        assert!(read(r#"{"voxels":1}"#).is_err());
    }
}
