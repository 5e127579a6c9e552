"""Why buttons cannot be pressed: English, German, French."""

# fmt: off

from __future__ import annotations

REFUSALS = (
    ("Nobody is in the scene: generate a person first",
     "Niemand ist in der Szene: zuerst eine Person erzeugen",
     "Il n'y a personne dans la scène : générer d'abord une personne"),
    ("No captures are being rendered",
     "Keine Aufnahmen werden gerendert",
     "Aucune capture n'est en cours de rendu"),
    ("No region is being painted: press Paint Region first",
     "Kein Bereich wird gemalt: zuerst „Bereich malen“ drücken",
     "Aucune région n'est en train d'être peinte : presser d'abord « Peindre la région »"),
    ("Nothing is in line",
     "Nichts ist in der Reihe",
     "Rien n'est en file"),
    ("Nothing has failed",
     "Nichts ist gescheitert",
     "Rien n'a échoué"),
    ("No work was left by an earlier Blender or file",
     "Kein Auftrag ist von früher übrig",
     "Aucune tâche ne reste d'un Blender ou fichier précédent"),
    ("Nobody is in the scene: generate a person, or select an armature with SMPL's joints",
     "Niemand ist in der Szene: eine Person erzeugen, oder eine Armatur mit SMPLs Gelenken auswählen",
     "Il n'y a personne dans la scène : générer une personne, ou sélectionner une armature aux articulations de SMPL"),
    ("Nothing is being set up",
     "Nichts wird gerade eingerichtet",
     "Rien n'est en cours d'installation"),
    ("There are no variations: press Show Variations first",
     "Keine Varianten da: zuerst „Varianten zeigen“ drücken",
     "Il n'y a pas de variantes : presser d'abord « Montrer des variantes »"),
    ("No result waits to enter the scene",
     "Kein Ergebnis wartet auf die Szene",
     "Aucun résultat n'attend d'entrer dans la scène"),
)
