"""The program: commands, jobs over many views and devices, reports, evaluation, studies, made scenes."""
