//! The command line as texts for other programs: shell completions and a manual page.

use anyhow::Result;
use clap_complete::Shell;

use crate::cli::command;
use crate::os;

const PROGRAM: &str = "shadow-repose";

/// Prints completions for a shell.
///
/// # Errors
/// Fails if stdout cannot be written to.
pub fn completions(shell: Shell) -> Result<()> {
    let (mut text, mut program) = (Vec::new(), command());
    if shell != Shell::Bash {
        clap_complete::generate(shell, &mut program, PROGRAM, &mut text);
        return os::print(&String::from_utf8(text)?);
    }
    // For a name with a hyphen, clap_complete 4.6 writes a script whose commands have two names, and completes nothing after one.
    clap_complete::generate(shell, &mut program.name("shadow_repose"), "shadow_repose", &mut text);
    let text = String::from_utf8(text)?.replace(" shadow_repose\n", &format!(" {PROGRAM}\n"));
    os::print(&text)
}

/// Prints a manual page of all commands.
///
/// # Errors
/// Fails if stdout cannot be written to.
pub fn man() -> Result<()> {
    let mut program = command().name(PROGRAM);
    program.build();
    let (mut page, whole) = (Vec::new(), clap_mangen::Man::new(program.clone()));
    whole.render_title(&mut page)?;
    whole.render_name_section(&mut page)?;
    whole.render_synopsis_section(&mut page)?;
    whole.render_description_section(&mut page)?;
    let mut page = String::from_utf8(page)?;
    for command in program.get_subcommands().filter(|command| command.get_name() != "help") {
        let (mut section, part) = (Vec::new(), clap_mangen::Man::new(command.clone()));
        part.render_description_section(&mut section)?;
        part.render_options_section(&mut section)?;
        part.render_extra_section(&mut section)?;
        // Sections of the command's own page are parts of one section here.
        let section = String::from_utf8(section)?.replace(".SH ", ".SS ");
        page += &format!(".SH \"SHADOW-REPOSE {}\"\n{section}", command.get_name().to_uppercase());
    }
    os::print(&page)
}
