"""From a folder of photographs to a refined model, stage by stage, in a workspace that can be taken up again."""
