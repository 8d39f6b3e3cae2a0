//! Time per frame by instruction set on one thread, and its ratio to the time with the widest instruction set.

use anyhow::Result;
use planish::{Engine, FrameParams, SensorModel, Strength};
use serde::Serialize;

use super::engines::Way;
use super::experiment::Bench;
use super::section::Section;
use super::timing::Timing;

#[derive(Serialize)]
struct Row {
    frame: String,
    preset: &'static str,
    engine: String,
    time: Timing,
    /// Ratio to the time of the preset's last row, the widest instruction set.
    times_the_widest: f64,
}

pub fn run(context: &Bench<'_>) -> Result<Section> {
    let mut section = Section::new("simd", "Instruction sets");
    section.note("Times are from the frame to the points, both in host memory, on one thread of the CPU engine.");
    let of_strength = |strength| FrameParams::for_sensor(SensorModel::KINECT_V1, strength);
    let presets = [
        ("light", of_strength(Strength::LIGHT)),
        ("default", FrameParams::default()),
        ("strong", of_strength(Strength::STRONG)),
        ("paper", FrameParams::paper()),
    ];
    let mut subjects = context.subjects(true)?;
    subjects.retain(|subject| subject.options.engine == Engine::Cpu && subject.options.threads == Some(1));
    if subjects.is_empty() {
        section.note("Not run without the CPU engine.");
    }
    let inputs = if context.options.quick { &context.inputs[..1] } else { &context.inputs[..] };
    let bar = context.bar("simd", inputs.len() * presets.len() * subjects.len())?;
    let mut rows = Vec::new();
    for (input, (preset, params)) in inputs.iter().flat_map(|input| presets.map(|preset| (input, preset))) {
        let mut of_preset = Vec::new();
        for subject in subjects.iter().filter(|_| !context.stopped()) {
            let timed = context.time_way(subject, params, input, Way::CopiedOut, 1);
            if let Some(time) = context.attempt(&format!("{}, {preset}", subject.name), timed)? {
                let (frame, engine) = (input.describe(), subject.name.clone());
                of_preset.push(Row { frame, preset, engine, time, times_the_widest: 1.0 });
            }
            bar.inc(1);
        }
        if let Some(widest) = of_preset.last().map(|row| row.time.ms.median) {
            of_preset.iter_mut().for_each(|row| row.times_the_widest = row.time.ms.median / widest);
        }
        rows.extend(of_preset);
    }
    bar.finish_and_clear();
    section.table(
        &["frame", "preset", "engine", "ms per frame, median", "times the widest"],
        rows.iter().map(|row| {
            let ratio = format!("{:.2}", row.times_the_widest);
            vec![row.frame.clone(), row.preset.to_owned(), row.engine.clone(), row.time.cell(), ratio]
        }),
    );
    section.note_noise(rows.iter().map(|row| row.time.noisy));
    section.json = serde_json::to_value(&rows)?;
    Ok(section)
}
