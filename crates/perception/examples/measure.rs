//! How well and how fast random tables are detected: one JSON document on standard output. Run it by `scripts/bench-perception`.
//!
//! `measure [--tables N] [--first SEED] [--drawn things|models] [--calibration exact|realistic|rough] [--surface] [--pictures DIR]`: objects are
//! seen as things with details of their own, by a sensor with correlated noise and flying pixels, or as the detector's own models under
//! independent noise. With `--calibration` the camera is not where the detector is told, by errors of the size that it is told (those of
//! `[cell.errors]`); with `--surface` the detector knows the height of the table. With `--pictures` the image of every table on which
//! something went wrong is kept, with what was found drawn into it.

#![allow(clippy::print_stdout, clippy::disallowed_methods, reason = "an example prints")]

use ratn_perception::calibration::{Calibration, Surface};
use ratn_perception::camera::Camera;
use ratn_perception::detection::{ObjectClass, segment};
use ratn_perception::noise::Noise;
use ratn_perception::picture::Picture;
use ratn_perception::sensor::Sensor;
use ratn_perception::trial::{self, Match, Placed};
use std::path::PathBuf;

struct Setting {
    name: &'static str,
    eye: [f64; 3],
    frames: u32,
}

/// From the mast, over a second's frames and a single one; and from as near as an arm holds a camera.
const SETTINGS: [Setting; 3] = [
    Setting { name: "mast, 10 frames", eye: [-0.62, 0.0, 1.88], frames: 10 },
    Setting { name: "mast, 1 frame", eye: [-0.62, 0.0, 1.88], frames: 1 },
    Setting { name: "near, 1 frame", eye: [-0.05, 0.0, 1.60], frames: 1 },
];

/// What is measured.
struct Choice {
    seeds: std::ops::Range<u64>,
    as_things: bool,
    /// The variances of where the camera is, as told; and of its errors.
    calibration: Calibration,
    surface: Option<Surface>,
    pictures: Option<PathBuf>,
}

/// The table's height as the detector worker takes a surface that a task gives: `SURFACE_SIGMA_M` and `SURFACE_SIGMA_RAD` there.
const SURFACE: Surface = Surface { height_m: trial::TABLE[2], sigma_m: 0.001, sigma_rad: 0.002 };

/// Variances of place and direction of deviations in metres and radians.
fn calibration(metres: f64, radians: f64) -> Calibration {
    std::array::from_fn(|i| if i < 3 { metres } else { radians }.powi(2))
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let (mut tables, mut first) = (200_u64, 0_u64);
    let mut choice = Choice { seeds: 0..0, as_things: true, calibration: [0.0; 6], surface: None, pictures: None };
    let mut named = "exact".to_owned();
    let mut arguments = std::env::args().skip(1);
    while let Some(name) = arguments.next() {
        if name == "--surface" {
            choice.surface = Some(SURFACE);
            continue;
        }
        let value = arguments.next().ok_or(format!("{name} needs a value"))?;
        match (name.as_str(), value.as_str()) {
            ("--tables", _) => tables = value.parse()?,
            ("--first", _) => first = value.parse()?,
            ("--drawn", "things" | "models") => choice.as_things = value == "things",
            // As `ErrorsConfig::REALISTIC` and `ErrorsConfig::ROUGH` of the cell.
            ("--calibration", "exact") => choice.calibration = [0.0; 6],
            ("--calibration", "realistic") => choice.calibration = calibration(0.001, 0.00175),
            ("--calibration", "rough") => choice.calibration = calibration(0.003, 0.00524),
            ("--pictures", _) => choice.pictures = Some(value.clone().into()),
            _ => return Err(format!("unknown argument {name} {value}").into()),
        }
        if name == "--calibration" {
            named = value;
        }
    }
    choice.seeds = first..first + tables;
    let measured: Result<Vec<String>, _> = SETTINGS.iter().map(|setting| measure(setting, &choice)).collect();
    let drawn = if choice.as_things { "things" } else { "models" };
    println!(
        "{{\"drawn\": \"{drawn}\", \"calibration\": \"{named}\", \"surface\": {}, \"tables\": {tables}, \"first_seed\": {first}, \"settings\": [{}]}}",
        choice.surface.is_some(),
        measured?.join(",\n")
    );
    Ok(())
}

fn measure(setting: &Setting, choice: &Choice) -> Result<String, Box<dyn std::error::Error>> {
    let camera = Camera::looking(setting.eye, trial::TABLE, trial::OPTICS);
    let (mut matches, mut phantoms, mut times): (Vec<Match>, usize, Vec<f64>) = Default::default();
    for seed in choice.seeds.clone() {
        let truly = trial::miscalibrated(&camera, &choice.calibration, seed);
        let count = 1 + (seed % 8) as usize;
        let (table, image): (Vec<Placed>, _) = if choice.as_things {
            let table = trial::random_things(seed, count, &camera);
            let image = trial::things_image(&table, &truly, &Sensor::DEFAULT, seed, setting.frames);
            (table, image)
        } else {
            let table = trial::random_table(seed, count, &camera);
            let image = trial::table_image(&table, &truly, &Noise::DEFAULT, seed, setting.frames);
            (table, image)
        };
        let start = processor_s()?;
        let found = segment(&image, &camera, &trial::region(), &ObjectClass::ALL, &[])?.into_iter().map(|object| {
            let object = object.with_calibration(&camera, &choice.calibration);
            choice.surface.map_or(object, |surface| object.standing_on(&surface, &camera, &choice.calibration))
        });
        let found: Vec<_> = found.collect();
        times.push((processor_s()? - start) * 1e3);
        let (of_table, phantom) = trial::compare(&table, &found);
        if let Some(directory) = choice.pictures.as_deref()
            && (!phantom.is_empty() || of_table.iter().any(|m| !m.is_good()))
        {
            let mut picture = Picture::of_depth(&image);
            found.iter().for_each(|f| picture.draw(&camera, f));
            let name = format!("{}-{seed}.png", setting.name.replace([' ', ','], "_"));
            std::fs::write(directory.join(name), picture.to_png()?)?;
            for m in of_table.iter().filter(|m| !m.is_good()) {
                let found = m.found.map(|f| (f.model, f.confidence));
                eprintln!(
                    "{} {seed}: {:?} at {:.3?} as {found:.3?} {:.1} mm {:.1}°",
                    setting.name,
                    m.truth.model,
                    m.truth.pose.position,
                    m.position * 1e3,
                    m.angle.to_degrees()
                );
            }
            phantom.iter().for_each(|p| eprintln!("{} {seed}: nothing as {p:?}", setting.name));
        }
        phantoms += phantom.len();
        matches.extend(of_table);
    }
    let wrong = matches.iter().filter(|m| m.found.is_some() && !m.is_good()).count();
    let good = matches.iter().filter(|m| m.is_good()).count();
    let classes: Vec<String> = ObjectClass::ALL.iter().map(|class| of_class(*class, &matches)).collect();
    let distance = {
        let way: f64 = (0..3).map(|i| (setting.eye[i] - trial::TABLE[i]).powi(2)).sum();
        way.sqrt()
    };
    let reported = good + wrong + phantoms;
    Ok(format!(
        "{{\"setting\": \"{}\", \"camera_to_table_m\": {distance:.2}, \"frames\": {}, \"objects\": {}, \"found_within_5_mm_and_3_deg\": {:.4}, \
         \"wrong_class_or_place\": {wrong}, \"false\": {phantoms}, \"false_of_reported\": {:.4}, \"processor_ms_median\": {:.1}, \"processor_ms_p95\": {:.1}, \"processor_ms_max\": {:.1}, \
         \"normalised_square\": {:.2}, \"inside_95\": {:.3}, \"classes\": [{}]}}",
        setting.name,
        setting.frames,
        matches.len(),
        good as f64 / matches.len() as f64,
        phantoms as f64 / reported.max(1) as f64,
        quantile(&mut times, 0.5),
        quantile(&mut times, 0.95),
        quantile(&mut times, 1.0),
        consistency(matches.iter()),
        inside(matches.iter()),
        classes.join(", ")
    ))
}

/// How long this thread has been on a processor, in seconds: what else the machine does is not counted. Linux says so.
fn processor_s() -> Result<f64, Box<dyn std::error::Error>> {
    let said = std::fs::read_to_string("/proc/thread-self/schedstat")?;
    Ok(said.split_whitespace().next().ok_or("an empty schedstat")?.parse::<f64>()? * 1e-9)
}

/// The mean of the position's normalised squared errors: 1 where covariances are true.
fn consistency<'a>(matches: impl Iterator<Item = &'a Match>) -> f64 {
    let squares: Vec<f64> = matches.filter(|m| m.is_good()).filter_map(Match::normalised_square).collect();
    squares.iter().sum::<f64>() / squares.len().max(1) as f64
}

/// How many of those that were found of their class, however far off, are where their covariance says with 95 %.
fn inside<'a>(matches: impl Iterator<Item = &'a Match>) -> f64 {
    let of_class = matches.filter(|m| m.found.is_some_and(|f| f.model.class() == m.truth.model.class()));
    let inside: Vec<bool> = of_class.filter_map(Match::is_inside).collect();
    inside.iter().filter(|is| **is).count() as f64 / inside.len().max(1) as f64
}

fn of_class(class: ObjectClass, matches: &[Match]) -> String {
    let own: Vec<&Match> = matches.iter().filter(|m| m.truth.model.class() == class).collect();
    let good = own.iter().filter(|m| m.is_good()).count();
    let missed = own.iter().filter(|m| m.found.is_none()).count();
    let as_class =
        |class: ObjectClass| own.iter().filter(|m| m.found.is_some_and(|f| f.model.class() == class)).count();
    let seen_as = ObjectClass::ALL.iter().filter(|other| **other != class && as_class(**other) > 0);
    let seen_as: Vec<String> = seen_as.map(|other| format!("\"{}\": {}", other.name(), as_class(*other))).collect();
    let mut position: Vec<f64> = own.iter().filter(|m| m.found.is_some()).map(|m| m.position * 1e3).collect();
    let mut angle: Vec<f64> = own.iter().filter(|m| m.found.is_some()).map(|m| m.angle.to_degrees()).collect();
    format!(
        "{{\"class\": \"{}\", \"objects\": {}, \"found\": {:.4}, \"mm_median\": {:.2}, \"mm_p99\": {:.2}, \"deg_median\": {:.2}, \"deg_p99\": {:.2}, \"normalised_square\": {:.2}, \"inside_95\": {:.3}, \"missed\": {missed}, \"seen_as\": {{{}}}}}",
        class.name(),
        own.len(),
        good as f64 / own.len().max(1) as f64,
        quantile(&mut position, 0.5),
        quantile(&mut position, 0.99),
        quantile(&mut angle, 0.5),
        quantile(&mut angle, 0.99),
        consistency(own.iter().copied()),
        inside(own.iter().copied()),
        seen_as.join(", ")
    )
}

fn quantile(values: &mut [f64], part: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(((values.len().max(1) - 1) as f64 * part).round() as usize).copied().unwrap_or(f64::NAN)
}
