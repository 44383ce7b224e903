//! The panel beside the scene in the window: what is shown there, and what the user asks for.
//!
//! It knows names, numbers, bars and curves, not what they mean.

use std::collections::VecDeque;

use egui_plot::{HLine, Line, Plot, PlotPoints};
use mujoco_rs::viewer::egui::{self, Key, ProgressBar, RichText, Slider, Ui};

/// The slowest and the fastest pace, as multiples of real time.
pub const SPEEDS: std::ops::RangeInclusive<f64> = 0.05..=4.0;

/// A quantity as a bar.
#[derive(Clone, Debug, Default)]
pub struct Bar {
    /// Its name.
    pub name: &'static str,
    /// How much of the bar is filled, in [0, 1].
    pub share: f32,
    /// Its value in words.
    pub text: String,
}

/// The recent course of a quantity.
#[derive(Clone, Debug, Default)]
pub struct Curve {
    /// Its name and unit.
    pub name: &'static str,
    /// Points of time (s) and value, the oldest first.
    pub points: VecDeque<[f64; 2]>,
    /// A value to compare with, drawn as a line.
    pub level: Option<f64>,
}

/// What the panel shows.
#[derive(Clone, Debug, Default)]
pub struct Readout {
    /// Names and values.
    pub rows: Vec<(&'static str, String)>,
    /// Bars, below a heading each group.
    pub bars: Vec<(&'static str, Vec<Bar>)>,
    /// Curves.
    pub curves: Vec<Curve>,
}

/// What the user has asked for.
#[derive(Clone, Debug, PartialEq)]
pub struct Controls {
    /// Time stands still, but for single steps.
    pub paused: bool,
    /// The pace, as a multiple of real time.
    pub speed: f64,
    /// Which of the choices moves the hand.
    pub choice: usize,
    /// Single steps asked for since the last look.
    pub steps: u32,
    /// A new episode was asked for.
    pub reset: bool,
    /// A new goal was asked for.
    pub new_goal: bool,
}

/// The panel's state between two pictures.
pub struct Panel {
    /// Names of the choices.
    choices: Vec<&'static str>,
    pub readout: Readout,
    pub controls: Controls,
}

impl Panel {
    pub fn new(choices: Vec<&'static str>, choice: usize) -> Self {
        let controls = Controls { paused: false, speed: 1.0, choice, steps: 0, reset: false, new_goal: false };
        Self { choices, readout: Readout::default(), controls }
    }

    /// Draws the panel at the right of the window and takes in what is clicked and pressed.
    pub fn show(&mut self, ui: &mut Ui) {
        if !ui.egui_wants_keyboard_input() {
            self.take_keys(ui);
        }
        egui::Panel::right("shadow-repose").resizable(true).default_size(300.0).show(ui, |ui| {
            egui::ScrollArea::vertical().show(ui, |ui| {
                self.show_controls(ui);
                self.show_readout(ui);
            });
        });
    }

    fn take_keys(&mut self, ui: &Ui) {
        let controls = &mut self.controls;
        ui.input(|input| {
            // A slow machine sees several presses at once.
            let odd = |key| input.num_presses(key) % 2 == 1;
            controls.paused ^= odd(Key::Space);
            controls.steps += input.num_presses(Key::ArrowRight) as u32;
            controls.reset |= input.key_pressed(Key::R);
            controls.new_goal |= input.key_pressed(Key::G);
            let doublings = input.num_presses(Key::ArrowUp) as i32 - input.num_presses(Key::ArrowDown) as i32;
            controls.speed = (controls.speed * 2f64.powi(doublings)).clamp(*SPEEDS.start(), *SPEEDS.end());
            controls.choice = (controls.choice + input.num_presses(Key::P)) % self.choices.len();
        });
        // A single step of a scene that runs would not be seen.
        controls.paused |= controls.steps > 0;
    }

    fn show_controls(&mut self, ui: &mut Ui) {
        let controls = &mut self.controls;
        ui.add_space(4.0);
        ui.horizontal(|ui| {
            let pause = if controls.paused { "Go on (Space)" } else { "Pause (Space)" };
            controls.paused ^= ui.button(pause).clicked();
            if ui.button("Step (Right)").clicked() {
                controls.steps += 1;
                controls.paused = true;
            }
        });
        ui.horizontal(|ui| {
            controls.new_goal |= ui.button("New goal (G)").clicked();
            controls.reset |= ui.button("Reset (R)").clicked();
        });
        ui.horizontal(|ui| {
            ui.add(Slider::new(&mut controls.speed, SPEEDS).logarithmic(true).suffix(" ×"));
            ui.label("speed (Up, Down)");
        });
        ui.horizontal(|ui| {
            for (i, name) in self.choices.iter().enumerate() {
                ui.radio_value(&mut controls.choice, i, *name);
            }
            ui.label("(P)");
        });
        let help = "Drag turns the view, the right button moves it, the wheel zooms. Double-click the cube, then drag with Ctrl \
                    and Alt to pull it, with Ctrl to twist it.";
        ui.label(RichText::new(help).small().weak());
        ui.separator();
    }

    fn show_readout(&self, ui: &mut Ui) {
        egui::Grid::new("rows").num_columns(2).show(ui, |ui| {
            for (name, value) in &self.readout.rows {
                ui.label(*name);
                ui.label(RichText::new(value).strong().monospace());
                ui.end_row();
            }
        });
        for (heading, bars) in &self.readout.bars {
            ui.separator();
            ui.label(*heading);
            for bar in bars {
                ui.horizontal(|ui| {
                    ui.add_sized([70.0, 16.0], egui::Label::new(bar.name));
                    ui.add(
                        ProgressBar::new(bar.share.clamp(0.0, 1.0))
                            .desired_height(14.0)
                            .corner_radius(2)
                            .text(&bar.text),
                    );
                });
            }
        }
        for curve in &self.readout.curves {
            ui.separator();
            ui.label(curve.name);
            let plot = Plot::new(curve.name).height(90.0).show_x(false).include_y(0.0);
            plot.allow_drag(false).allow_zoom(false).allow_scroll(false).show(ui, |plot| {
                plot.line(Line::new(curve.name, PlotPoints::from_iter(curve.points.iter().copied())));
                if let Some(level) = curve.level {
                    plot.hline(HLine::new("level", level));
                }
            });
        }
    }
}
