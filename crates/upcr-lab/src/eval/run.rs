//! Methods over the pairs of a protocol: errors, recall and time, as a row of a table.

use std::fmt::Write;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use upcr::{PointCloud, Result, Rigid, Settings};

use super::methods::EvaluatedMethod;
use super::metrics::{PoseErrors, Recall, ShapeSpread, Tolerance, diameter};
use crate::data::Shapes;
use crate::data::pairs::{Coverage, Pair, Protocol};

/// What a method achieved under a protocol. Angles are in degrees, lengths in the clouds' unit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Name of the method.
    pub method: String,
    /// Which shapes are tested on: `upc`, `uc`, `nd`.
    pub protocol: String,
    /// `consistent`, `partial_shared` or `partial_independent`.
    pub overlap: String,
    /// Standard deviation of the noise.
    pub noise: f64,
    /// Number of pairs.
    pub pairs: usize,
    /// Root mean square error of the Euler angles.
    pub rmse_r_deg: f64,
    /// Mean absolute error of the Euler angles.
    pub mae_r_deg: f64,
    /// Root mean square error of the translations' components.
    pub rmse_t: f64,
    /// Mean absolute error of the translations' components.
    pub mae_t: f64,
    /// Mean rotation error.
    pub rre_mean_deg: f64,
    /// Mean length of the translations' differences.
    pub rte_mean: f64,
    /// Mean of Brégier's pose distance.
    pub me_bregier: f64,
    /// Share of the pairs within 5° and a tenth of the diameter.
    pub recall: f64,
    /// How many pairs these are.
    pub found: usize,
    /// Mean time of a pair.
    pub ms_per_pair: f64,
    /// Median time of a pair.
    pub ms_median: f64,
}

/// The name of what a cloud keeps.
pub fn overlap_name(coverage: Coverage) -> &'static str {
    match coverage {
        Coverage::Full => "consistent",
        Coverage::PartialShared => "partial_shared",
        Coverage::PartialIndependent => "partial_independent",
    }
}

/// Runs a method over the protocol's pair of every shape, one after the other. A pair that it refuses counts as the
/// identity. `told` is called after every pair.
///
/// # Errors
/// Where a shape has too few points.
pub fn evaluate(
    method: &EvaluatedMethod,
    settings: &Settings,
    shapes: &Shapes,
    (name, protocol): (&str, &Protocol),
    told: &mut dyn FnMut(usize),
) -> Result<Row> {
    let pair = |item: usize| protocol.pair(&shapes.points(item), item as u64);
    let tolerance = |pair: &Pair| Tolerance::object(diameter(&pair.source.points));
    let row = evaluate_pairs(method, settings, shapes.len(), pair, tolerance, told)?;
    Ok(Row {
        protocol: name.into(),
        overlap: overlap_name(protocol.coverage).into(),
        noise: protocol.noise.map_or(0.0, |noise| noise.sigma),
        ..row
    })
}

/// The same over `count` pairs of any origin, of each of which `tolerance` says how far off a pose may be.
///
/// # Errors
/// Where a pair cannot be had.
pub fn evaluate_pairs(
    method: &EvaluatedMethod,
    settings: &Settings,
    count: usize,
    pair: impl Fn(usize) -> Result<Pair>,
    tolerance: impl Fn(&Pair) -> Tolerance,
    told: &mut dyn FnMut(usize),
) -> Result<Row> {
    let mut poses = Vec::with_capacity(count);
    let mut tolerances = Vec::with_capacity(count);
    let mut bregier = 0.0;
    let mut times_ms = Vec::with_capacity(count);
    let mut warm = false;
    for item in 0..count {
        let pair = pair(item)?;
        let Pair { source, target, T_target_source } = &pair;
        if !std::mem::replace(&mut warm, true) {
            estimated(method, source, target, settings);
        }
        let start = Instant::now();
        let estimate = estimated(method, source, target, settings);
        times_ms.push(start.elapsed().as_secs_f64() * 1e3);
        bregier += ShapeSpread::of(&source.points).distance(&estimate, T_target_source);
        tolerances.push(tolerance(&pair));
        poses.push((estimate, *T_target_source));
        told(item + 1);
    }
    let errors = PoseErrors::of(&poses);
    let recall = Recall::of(&poses, |i| tolerances[i]);
    let mean_ms = times_ms.iter().sum::<f64>() / times_ms.len() as f64;
    times_ms.sort_by(f64::total_cmp);
    Ok(Row {
        method: method.name.clone(),
        protocol: String::new(),
        overlap: String::new(),
        noise: 0.0,
        pairs: poses.len(),
        rmse_r_deg: errors.euler_rmse_deg,
        mae_r_deg: errors.euler_mae_deg,
        rmse_t: errors.translation_rmse,
        mae_t: errors.translation_mae,
        rre_mean_deg: errors.rotation_mean_deg,
        rte_mean: errors.translation_mean,
        me_bregier: bregier / poses.len() as f64,
        recall: recall.share(),
        found: recall.found,
        ms_per_pair: mean_ms,
        ms_median: times_ms.get(times_ms.len() / 2).copied().unwrap_or(f64::NAN),
    })
}

fn estimated(
    method: &EvaluatedMethod,
    source: &PointCloud,
    target: &PointCloud,
    settings: &Settings,
) -> Rigid {
    method.estimate(source, target, settings).unwrap_or_else(|_| Rigid::identity())
}

/// A table's column: its name, and how a row fills it.
type Column = (&'static str, fn(&Row) -> String);

const COLUMNS: [Column; 14] = [
    ("protocol", |r| r.protocol.clone()),
    ("overlap", |r| r.overlap.clone()),
    ("method", |r| r.method.clone()),
    ("pairs", |r| r.pairs.to_string()),
    ("RMSE(R)°", |r| format!("{:.3}", r.rmse_r_deg)),
    ("MAE(R)°", |r| format!("{:.3}", r.mae_r_deg)),
    ("RMSE(t)", |r| format!("{:.5}", r.rmse_t)),
    ("MAE(t)", |r| format!("{:.5}", r.mae_t)),
    ("RRE°", |r| format!("{:.3}", r.rre_mean_deg)),
    ("RTE", |r| format!("{:.5}", r.rte_mean)),
    ("ME", |r| format!("{:.5}", r.me_bregier)),
    ("found", |r| r.found.to_string()),
    ("recall", |r| format!("{:.1} %", 100.0 * r.recall)),
    ("ms", |r| format!("{:.2}", r.ms_per_pair)),
];

/// Rows as a Markdown table.
pub fn markdown(rows: &[Row]) -> String {
    let mut text = String::new();
    let line = |cells: Vec<String>| format!("| {} |\n", cells.join(" | "));
    text.push_str(&line(COLUMNS.iter().map(|(name, _)| (*name).into()).collect()));
    let rules = (0..COLUMNS.len()).map(|column| if column < 3 { "---".into() } else { "---:".into() });
    text.push_str(&line(rules.collect()));
    for row in rows {
        text.push_str(&line(COLUMNS.iter().map(|(_, cell)| cell(row)).collect()));
    }
    text
}

/// Rows as comma-separated values, all digits kept.
pub fn csv(rows: &[Row]) -> String {
    let mut text = String::from(
        "method,protocol,overlap,noise,pairs,rmse_r_deg,mae_r_deg,rmse_t,mae_t,rre_mean_deg,rte_mean,me_bregier,\
         recall,found,ms_per_pair,ms_median\n",
    );
    for r in rows {
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{}",
            r.method,
            r.protocol,
            r.overlap,
            r.noise,
            r.pairs,
            r.rmse_r_deg,
            r.mae_r_deg,
            r.rmse_t,
            r.mae_t,
            r.rre_mean_deg,
            r.rte_mean,
            r.me_bregier,
            r.recall,
            r.found,
            r.ms_per_pair,
            r.ms_median
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random;

    /// An ellipsoid with a bump: no two poses look alike.
    fn shapes(count: u64) -> Shapes {
        let cloud = |seed| {
            let mut rng = random::stream(seed, 0);
            (0..1200)
                .map(|_| {
                    let d = random::direction(&mut rng);
                    let bump = 1.0 + 0.4 * (4.0 * d.x + d.y).sin() * d.z.max(0.0);
                    [d.x * bump, 0.7 * d.y * bump, 0.5 * d.z * bump].map(|v| v as f32)
                })
                .collect()
        };
        Shapes { clouds: (0..count).map(cloud).collect(), labels: vec![0; count as usize], names: vec![] }
    }

    #[test]
    fn rows_are_what_the_poses_say() {
        let method = EvaluatedMethod::by_name("default").unwrap();
        let mut told = Vec::new();
        let row = evaluate(
            &method,
            &Settings::default(),
            &shapes(3),
            ("upc", &Protocol::CONSISTENT),
            &mut |done| told.push(done),
        )
        .unwrap();
        assert_eq!((told, row.pairs, row.found, row.recall), (vec![1, 2, 3], 3, 3, 1.0));
        assert!(row.mae_r_deg < 0.1 && row.rmse_t < 1e-2 && row.me_bregier < 1e-2, "{row:?}");
        assert!(row.ms_per_pair > 0.0);
        assert_eq!((row.protocol.as_str(), row.overlap.as_str(), row.noise), ("upc", "consistent", 0.0));
        let table = markdown(std::slice::from_ref(&row));
        assert_eq!(table.lines().count(), 3);
        assert!(table.contains("| default | 3 |"), "{table}");
        let csv = csv(&[row]);
        let widths: Vec<usize> = csv.lines().map(|line| line.split(',').count()).collect();
        assert_eq!(widths, [16, 16]);
    }

    #[test]
    fn a_method_that_refuses_counts_as_the_identity() {
        let mut flat = shapes(1);
        for p in &mut flat.clouds[0] {
            *p = [p[0], 0.0, 0.0];
        }
        let method = EvaluatedMethod::by_name("icp").unwrap();
        let protocol = Protocol::CONSISTENT;
        let row = evaluate(&method, &Settings::default(), &flat, ("upc", &protocol), &mut |_| {}).unwrap();
        let truth = protocol.pair(&flat.points(0), 0).unwrap().T_target_source;
        assert!((row.rre_mean_deg - truth.angle().to_degrees()).abs() < 1e-6);
        assert_eq!(row.found, 0);
    }

    #[test]
    fn unknown_methods_are_refused() {
        assert!(EvaluatedMethod::by_name("magic").is_err());
    }
}
