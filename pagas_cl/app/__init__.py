"""The program: commands, reports, evaluation, studies, made scenes."""
