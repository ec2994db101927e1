//! The page of a merge: all scans in their models, the graph of the pairs, and why each was kept or not.

use std::collections::BTreeMap;

use serde::Serialize;
use upcr::multiway::{Merged, Place, Scans};
use upcr::{Reason, Result, Rigid, TRUSTWORTHY};

use crate::display::{Displayed, Drawn, MOST_POINTS};
use crate::html::{Contents, assemble, json};

/// What was made of many scans, each with its name.
#[derive(Debug, Clone)]
pub struct MergePage<'a> {
    merged: &'a Merged,
    names: &'a [String],
    most_points: usize,
}

#[derive(Serialize)]
struct Told<'a> {
    version: &'static str,
    scans: Vec<ToldScan<'a>>,
    merge: &'a Merged,
    /// Probability from which on a pair is trusted.
    threshold: f64,
    /// What the reasons against pairs say.
    reasons: BTreeMap<String, String>,
}

#[derive(Serialize)]
struct ToldScan<'a> {
    name: &'a str,
    /// Where its middle lies in its model.
    center: Option<[f64; 3]>,
    /// Its points, where they lie in its model; of a scan without a model, in its own frame.
    drawn: Option<Drawn>,
}

impl<'a> MergePage<'a> {
    /// Of scans that have these names.
    pub fn new(merged: &'a Merged, names: &'a [String]) -> Self {
        Self { merged, names, most_points: MOST_POINTS }
    }

    /// Thinned to so many points, all scans together.
    #[must_use]
    pub fn with_most_points(mut self, most: usize) -> Self {
        self.most_points = most;
        self
    }

    /// The page. One scan is held at a time; `progress` hears how many are done.
    ///
    /// # Errors
    /// Where a scan that was merged cannot be read any more.
    pub fn html(&self, scans: &(impl Scans + ?Sized), progress: &dyn Fn(usize)) -> Result<String> {
        Ok(assemble(&self.contents(scans, progress)?))
    }

    /// What the page's script reads.
    ///
    /// # Errors
    /// As [`Self::html`].
    pub fn contents(&self, scans: &(impl Scans + ?Sized), progress: &dyn Fn(usize)) -> Result<Contents> {
        let usable = self.merged.places.iter().filter(|p| !matches!(p, Place::Unusable { .. })).count();
        let most = (self.most_points / usable.max(1)).max(1);
        let mut blobs = Vec::new();
        let mut told = Vec::new();
        for (scan, (name, place)) in self.names.iter().zip(&self.merged.places).enumerate() {
            progress(scan);
            let pose = match place {
                Place::Placed { T_model_scan, .. } => *T_model_scan,
                Place::Alone => Rigid::identity(),
                Place::Unusable { .. } => {
                    told.push(ToldScan { name, center: None, drawn: None });
                    continue;
                }
            };
            let cloud = scans.read(scan)?;
            let thinned = Displayed::new(&cloud, most)?;
            let moved = thinned.moved(&pose);
            let drawn = Displayed::new(&moved, most)?.draw(scan, &mut blobs);
            let placed = matches!(place, Place::Placed { .. });
            told.push(ToldScan {
                name,
                center: self.merged.graph.centers.get(scan).filter(|_| placed).map(|&c| pose.apply(c)),
                drawn: Some(Drawn { points: cloud.len(), left_out: thinned.left_out, ..drawn }),
            });
        }
        let mut reasons = BTreeMap::new();
        for &reason in self.merged.pairs.iter().flat_map(|pair| &pair.attempt.reasons) {
            reasons.insert(named(reason), reason.to_string());
        }
        let version = env!("CARGO_PKG_VERSION");
        let told = Told { version, scans: told, merge: self.merged, threshold: TRUSTWORTHY, reasons };
        Ok(Contents { words: json(&told), blobs })
    }
}

/// As JSON has it.
fn named(reason: Reason) -> String {
    let name = serde_json::to_value(reason).ok();
    name.and_then(|name| name.as_str().map(str::to_owned)).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use upcr::PointCloud;
    use upcr::multiway::{Attempt, JudgedAttempt, PoseGraph, Proposal};

    use super::*;

    const HOSTILE: &str =
        "</script><script>alert(1)</script><!--<img src=x onerror=alert(2)>&amp;\u{2028}.ply";

    /// Far from any origin, as surveys have it.
    const FAR: [f64; 3] = [4.5e5, 5.4e6, 300.0];

    fn scan(n: usize) -> PointCloud {
        let point = |i: usize| [0.01 * i as f64, (0.1 * i as f64).sin(), 0.0];
        PointCloud {
            colors: Some((0..n).map(|i| [i as u8, 0, 0]).collect()),
            ..PointCloud::from_points((0..n).map(point).collect())
        }
    }

    fn pair(source: usize, target: usize, chi_sq: Option<f64>, kept: bool) -> JudgedAttempt {
        let attempt = Attempt {
            source,
            target,
            proposal: Proposal::Overlap,
            prior: None,
            T_target_source: Rigid::identity().to_rows(),
            probability: 0.75,
            covariance: [[0.0; 6]; 6],
            fitness: 0.5,
            reasons: vec![Reason::LowOverlap],
        };
        JudgedAttempt { attempt, kept, contradicted: false, chi_sq }
    }

    fn merged() -> Merged {
        let placed = |at: [f64; 3]| Place::Placed {
            model: 0,
            T_model_scan: Rigid::from_translation(at),
            pairs: 1,
            probability: 0.75,
        };
        let unusable = Place::Unusable { reason: HOSTILE.into() };
        Merged {
            places: vec![placed(FAR), placed([FAR[0] + 1.0, FAR[1], FAR[2]]), Place::Alone, unusable],
            pairs: vec![pair(1, 0, Some(2.0), true), pair(2, 0, None, false)],
            graph: PoseGraph { centers: vec![[1.0, 2.0, 3.0]; 4], edges: Vec::new() },
            voxel_size: 0.05,
            inflation: 1.0,
        }
    }

    fn read(contents: &Contents) -> serde_json::Value {
        serde_json::from_str(&contents.words).unwrap()
    }

    #[test]
    fn scans_lie_in_their_models_to_the_last_digit_that_is_drawn() {
        let (merged, names) = (merged(), ["a", "b", "c", "d"].map(String::from));
        let scans = [scan(200), scan(300), scan(10), scan(0)];
        let contents = MergePage::new(&merged, &names).contents(&scans[..], &|_| ()).unwrap();
        let told = read(&contents);
        for (i, at) in [(0, FAR[0]), (1, FAR[0] + 1.0), (2, 0.0)] {
            let drawn = &told["scans"][i]["drawn"];
            let (origin, step) = (drawn["origin"][0].as_f64().unwrap(), drawn["step"].as_f64().unwrap());
            let blob = &contents.blobs.iter().find(|(name, _)| *name == format!("points-{i}")).unwrap().1;
            let mut xs: Vec<f64> = (blob.chunks(9))
                .map(|p| origin + step * f64::from(u32::from_le_bytes([p[0], p[1], p[2], 0])))
                .collect();
            xs.sort_by(f64::total_cmp);
            assert_eq!(xs.len(), scans[i].len());
            assert!(xs.iter().enumerate().all(|(k, x)| (x - at - 0.01 * k as f64).abs() < 1e-6), "{i}");
        }
        assert_eq!(told["scans"][0]["center"], serde_json::json!([FAR[0] + 1.0, FAR[1] + 2.0, FAR[2] + 3.0]));
        assert!(told["scans"][2]["center"].is_null() && told["scans"][3]["drawn"].is_null());
        assert_eq!(told["merge"], serde_json::to_value(&merged).unwrap());
        assert_eq!(told["reasons"]["low_overlap"], Reason::LowOverlap.to_string());
    }

    #[test]
    fn all_scans_together_have_no_more_points_than_one_cloud() {
        let (merged, names) = (merged(), ["a", "b", "c", "d"].map(String::from));
        let scans = [scan(200), scan(300), scan(10), scan(0)];
        let page = MergePage::new(&merged, &names).with_most_points(90);
        let heard = std::cell::RefCell::new(BTreeSet::new());
        let contents = page
            .contents(&scans[..], &|done| {
                heard.borrow_mut().insert(done);
            })
            .unwrap();
        let told = read(&contents);
        let shown = |i: usize| (&told["scans"][i]["drawn"]["shown"], &told["scans"][i]["drawn"]["points"]);
        assert_eq!(shown(0), (&30.into(), &200.into()));
        assert_eq!(shown(2), (&10.into(), &10.into()));
        let bytes: usize = contents.blobs.iter().map(|(_, bytes)| bytes.len()).sum();
        assert_eq!(bytes, 70 * (9 + 3));
        assert_eq!(heard.into_inner().len(), 4);
    }

    #[test]
    fn names_and_reasons_are_data_never_markup() {
        let (merged, names) = (merged(), [HOSTILE, "b", "c", "d"].map(String::from));
        let scans = [scan(20), scan(20), scan(10), scan(0)];
        let html = MergePage::new(&merged, &names).html(&scans[..], &|_| ()).unwrap();
        assert!(!html.contains("alert(1)</script>") && !html.contains("<img") && !html.contains('\u{2028}'));
        assert_eq!(html.matches("<script").count(), html.matches("</script>").count());
        // The words, points and colours of three scans, the script.
        assert_eq!(html.matches("<script").count(), 8);
    }

    #[test]
    fn a_merge_that_placed_nothing_has_a_page_too() {
        let unusable = || Place::Unusable { reason: "empty".into() };
        let merged = Merged { places: vec![unusable(), unusable()], pairs: Vec::new(), ..merged() };
        let scans = [scan(0), scan(0)];
        let html = MergePage::new(&merged, &["a", "b"].map(String::from)).html(&scans[..], &|_| ()).unwrap();
        assert_eq!(html.matches("<script").count(), 2);
    }
}
