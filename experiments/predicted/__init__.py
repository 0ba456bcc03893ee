"""How well predicted gains tell realised ones: parts of `experiments.predicted_gain`.

The definitions, written down before the runs.

- A *case* is one batch: (scene, policy, seed, round). *Predicted* is what `bavs_jax/prediction.py`
  said when the batch was chosen; the predictor that counts is `variance_db`, all others are there
  to compare with. *Realised* is the mean PSNR of the test views after the round that trained on
  the batch, less that before it, dB, both over the same test views; it may be below 0. A case
  whose two rounds were measured on other numbers of test views is left out and counted.
- *Rank correlation* is Spearman's. *Pooled* is over all cases; since both fall from round to
  round, pooled is flattered by that trend. *Within rounds* ranks the cases of one scene and one
  round number among themselves, *within seeds* those of one scene, round number and seed (who of
  the policies has the better batch); both are means over groups with weights n - 1, so that with
  nothing to find the standard error is `1 / sqrt(sum (n - 1))`.
- *Calibration* maps predicted to realised: the least-squares line `a + b predicted`, with b >= 0,
  of the cases of all other seeds (leave one seed out), or of all other scenes (leave one scene
  out), which is what someone has who stands before a new scene. Its error is the root mean
  square of what it misses, beside that of a constant, the mean realised gain of the same cases.
- *Stop rule*: stop when the calibrated prediction of the next batch is less than x dB. It hits
  where it stops and less than x dB was realised, or goes on and x dB or more was. A false stop
  throws x dB or more away; a missed stop takes a batch that was not worth it. The base rate is the
  hit rate of the better of always stopping and never stopping.
- *Planned*: with `--planned` all batches of a run are predicted from the field of its initial
  views, each given those before it. This is what can be said where no field can be trained in
  between, and all that can be said of runs that recorded no predictions. The first batch is the
  same either way. (This point was added when some runs had ended, before any of it was computed.)
- *Fit to be told to a user* (`experiments.suggest_views`) is a worth in dB only if, calibrated on
  other scenes, its error is at most 0.8 times that of a constant, and less than that of counting
  views alone; and if the correlation within rounds is more than two standard errors above 0.
"""
