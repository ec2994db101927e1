//! The page of clouds, or of a registration of two.

use serde::Serialize;
use upcr::{PointCloud, Registration, Result, Rigid, TRUSTWORTHY};

use crate::display::{Displayed, Drawn, MOST_POINTS, Surface, range};
use crate::html::{Contents, assemble, json};
use crate::notation::{Notation, notations};

/// Comments of one file that a page tells, and characters of each.
const MOST_COMMENTS: usize = 20;
const LONGEST_COMMENT: usize = 300;

/// Clouds, and what is known of the pose that lays the first on the second.
#[derive(Debug, Clone)]
pub struct Page<'a> {
    clouds: Vec<(&'a str, &'a PointCloud)>,
    poses: Vec<(Rigid, Option<f64>)>,
    found: Option<&'a Registration>,
    comments: Vec<Vec<String>>,
    most_points: usize,
}

#[derive(Serialize)]
struct Told<'a> {
    version: &'static str,
    clouds: Vec<ToldCloud<'a>>,
    poses: Vec<ToldPose>,
    distances: Option<ToldDistances>,
    verdict: Option<ToldVerdict<'a>>,
    registration: Option<&'a Registration>,
}

#[derive(Serialize)]
struct ToldCloud<'a> {
    name: &'a str,
    #[serde(flatten)]
    drawn: Drawn,
    comments: &'a [String],
}

#[derive(Serialize)]
struct ToldPose {
    T_target_source: Rigid,
    relative_score: Option<f64>,
    notations: Vec<Notation>,
}

#[derive(Serialize)]
struct ToldDistances {
    reach: f64,
    range: f64,
}

#[derive(Serialize)]
struct ToldVerdict<'a> {
    registered: bool,
    threshold: f64,
    reasons: Vec<ToldReason<'a>>,
    free: Vec<String>,
    source_scale: Option<f64>,
}

#[derive(Serialize)]
struct ToldReason<'a> {
    name: &'a upcr::Reason,
    text: String,
}

impl<'a> Page<'a> {
    /// Of clouds as they lie, each with its name.
    pub fn of_clouds(clouds: &[(&'a str, &'a PointCloud)]) -> Self {
        Self {
            clouds: clouds.to_vec(),
            poses: Vec::new(),
            found: None,
            comments: Vec::new(),
            most_points: MOST_POINTS,
        }
    }

    /// Of a registration: its pose and the alternatives, the verdict, the settings, the times.
    pub fn of_registration(
        source: (&'a str, &'a PointCloud),
        target: (&'a str, &'a PointCloud),
        found: &'a Registration,
    ) -> Self {
        let others = found.alternatives.iter().map(|a| (a.T_target_source, Some(a.relative_score)));
        let poses = std::iter::once((found.T_target_source, None)).chain(others).collect();
        Self { poses, found: Some(found), ..Self::of_clouds(&[source, target]) }
    }

    /// With a pose that moves the first cloud.
    #[must_use]
    pub fn with_pose(mut self, pose: &Rigid) -> Self {
        self.poses = vec![(*pose, None)];
        self
    }

    /// With what each cloud's file says of itself, in the clouds' order; of much, the beginning.
    #[must_use]
    pub fn with_comments(mut self, comments: &[Vec<String>]) -> Self {
        let brief = |text: &String| match text.char_indices().nth(LONGEST_COMMENT) {
            Some((end, _)) => format!("{}…", &text[..end]),
            None => text.clone(),
        };
        self.comments =
            comments.iter().map(|all| all.iter().take(MOST_COMMENTS).map(brief).collect()).collect();
        self
    }

    /// Thinned to so many points a cloud, where there are more.
    #[must_use]
    pub fn with_most_points(mut self, most: usize) -> Self {
        self.most_points = most.max(1);
        self
    }

    /// The page.
    ///
    /// # Errors
    /// [`upcr::Error::TooFewPoints`] where a cloud has no point with finite coordinates.
    pub fn html(&self) -> Result<String> {
        Ok(assemble(&self.contents()?))
    }

    /// What the page's script reads.
    ///
    /// # Errors
    /// As [`Self::html`].
    pub fn contents(&self) -> Result<Contents> {
        let shown: Vec<Displayed> = self
            .clouds
            .iter()
            .map(|(_, cloud)| Displayed::new(cloud, self.most_points))
            .collect::<Result<_>>()?;
        let mut blobs: Vec<(String, Vec<u8>)> = Vec::new();
        let mut clouds = Vec::new();
        for (i, ((name, _), shown)) in self.clouds.iter().zip(&shown).enumerate() {
            clouds.push(ToldCloud {
                name,
                drawn: shown.draw(i, &mut blobs),
                comments: self.comments.get(i).map_or(&[], Vec::as_slice),
            });
        }

        let surface = match &shown[..] {
            [_, target, ..] => Surface::new(self.clouds[1].1, target),
            _ => None,
        };
        let distances = surface.map(|surface| {
            let lying = [Rigid::identity()];
            let poses = lying.iter().chain(self.poses.iter().map(|(pose, _)| pose));
            let told: Vec<Vec<u16>> = poses.map(|pose| surface.distances(&shown[0], pose)).collect();
            let shown_first = &told[usize::from(told.len() > 1)];
            let range = range(self.found.map(|f| f.voxel_size), shown_first, surface.reach);
            for (i, told) in told.iter().enumerate() {
                blobs.push((format!("distances-{i}"), told.iter().flat_map(|d| d.to_le_bytes()).collect()));
            }
            ToldDistances { reach: surface.reach, range }
        });
        let told = Told {
            version: env!("CARGO_PKG_VERSION"),
            clouds,
            poses: self.poses.iter().map(|&(pose, score)| told_pose(pose, score)).collect(),
            distances,
            verdict: self.found.map(told_verdict),
            registration: self.found,
        };
        Ok(Contents { words: json(&told), blobs })
    }
}

fn told_pose(T_target_source: Rigid, relative_score: Option<f64>) -> ToldPose {
    ToldPose { T_target_source, relative_score, notations: notations(&T_target_source) }
}

fn told_verdict(found: &Registration) -> ToldVerdict<'_> {
    ToldVerdict {
        registered: found.is_trustworthy(),
        threshold: TRUSTWORTHY,
        reasons: found.reasons.iter().map(|name| ToldReason { name, text: name.to_string() }).collect(),
        free: found.free_directions.iter().map(ToString::to_string).collect(),
        source_scale: found.source_scale,
    }
}

#[cfg(test)]
mod tests {
    use upcr::{Settings, register};

    use super::*;

    const HOSTILE: &str =
        "</script><script>alert(1)</script><!--<img src=x onerror=alert(2)>&amp;\u{2028}.ply";

    fn cloud(shift: usize) -> PointCloud {
        let point = |i: usize| {
            let (u, v) = (0.02 * ((i + shift) % 70) as f64, 0.03 * (i / 70) as f64);
            [u, v, (3.0 * u).sin() + 0.3 * (5.0 * v + u).cos()]
        };
        PointCloud::from_points((0..4000).map(point).collect())
    }

    /// What the page tells, and the names of what it holds.
    fn read(html: &str) -> (serde_json::Value, Vec<&str>) {
        let start = "id=\"page\">";
        let from = html.find(start).unwrap() + start.len();
        let text = &html[from..from + html[from..].find("</script>").unwrap()];
        let ids = html.split("type=\"text/plain\" id=\"").skip(1).map(|t| t.split('"').next().unwrap());
        (serde_json::from_str(text).unwrap(), ids.collect())
    }

    #[test]
    fn a_page_tells_all_that_the_registration_does() {
        let (a, b) = (cloud(0), cloud(3));
        let found = register(&a, &b, &Settings::default()).unwrap();
        let html = Page::of_registration(("a.ply", &a), ("b.ply", &b), &found).html().unwrap();
        let (told, ids) = read(&html);
        assert_eq!(told["registration"], serde_json::to_value(&found).unwrap());
        assert_eq!(told["poses"].as_array().unwrap().len(), 1 + found.alternatives.len());
        assert_eq!(told["verdict"]["registered"], found.is_trustworthy());
        assert_eq!(told["clouds"][0]["shown"], 4000);
        assert!(ids.starts_with(&["points-0", "points-1", "distances-0", "distances-1"]), "{ids:?}");
    }

    #[test]
    fn names_are_data_never_markup() {
        let cloud = cloud(0);
        let html = Page::of_clouds(&[(HOSTILE, &cloud), ("b", &cloud)]).html().unwrap();
        let (told, _) = read(&html);
        assert_eq!(told["clouds"][0]["name"], HOSTILE);
        assert!(!html.contains("alert(1)</script>") && !html.contains("<img") && !html.contains('\u{2028}'));
        let scripts = html.matches("<script").count();
        assert_eq!(scripts, html.matches("</script>").count());
        // The words, two clouds, the distances as they lie, the script.
        assert_eq!(scripts, 5);
    }

    #[test]
    fn comments_are_told_in_brief() {
        let cloud = cloud(0);
        let comments = [vec![HOSTILE.to_owned(), "ä".repeat(1000)], vec![String::new(); 1000]];
        let page = Page::of_clouds(&[("a", &cloud), ("b", &cloud), ("c", &cloud)]).with_comments(&comments);
        let html = page.html().unwrap();
        let (told, _) = read(&html);
        assert_eq!(told["clouds"][0]["comments"][0], HOSTILE);
        assert_eq!(told["clouds"][0]["comments"][1], format!("{}…", "ä".repeat(LONGEST_COMMENT)));
        assert_eq!(told["clouds"][1]["comments"].as_array().unwrap().len(), MOST_COMMENTS);
        assert_eq!(told["clouds"][2]["comments"].as_array().unwrap().len(), 0);
        assert!(!html.contains("alert(1)</script>") && !html.contains("<img"));
    }

    #[test]
    fn thinning_is_told() {
        let cloud = cloud(0);
        let page = Page::of_clouds(&[("a", &cloud)]).with_most_points(100).with_pose(&Rigid::identity());
        let html = page.html().unwrap();
        let (told, ids) = read(&html);
        assert_eq!((&told["clouds"][0]["points"], &told["clouds"][0]["shown"]), (&4000.into(), &100.into()));
        assert_eq!(ids, ["points-0"]);
    }
}
