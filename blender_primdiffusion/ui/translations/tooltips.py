"""What is said under the mouse: English, German, French. Operators, and the settings that people meet first."""

from __future__ import annotations

TOOLTIPS = (
    (
        "Add a camera that frames the selected person, or everybody, and a sun for other objects",
        "Eine Kamera hinzufügen, die die gewählte Person oder alle zeigt, und eine Sonne für andere Objekte",
        "Ajouter une caméra qui cadre la personne choisie, ou tout le monde, et un soleil pour les autres objets",
    ),
    (
        "Put a built-in motion onto the person",
        "Der Person eine eingebaute Bewegung geben",
        "Donner à la personne un mouvement intégré",
    ),
    (
        "Give the person the chosen pose of the library",
        "Der Person die gewählte Pose der Bibliothek geben",
        "Donner à la personne la pose choisie de la bibliothèque",
    ),
    (
        "Move the selected person towards another one, who stays as they are",
        "Die gewählte Person einer anderen annähern, die bleibt, wie sie ist",
        "Rapprocher la personne choisie d'une autre, qui reste telle quelle",
    ),
    (
        "Add the selected people to the scene, exactly as seen, side by side",
        "Die gewählten Personen genau wie gezeigt nebeneinander in die Szene stellen",
        "Ajouter les personnes choisies à la scène, exactement comme on les voit, côte à côte",
    ),
    (
        "Stop this work, or take it out of the line; nothing is added to the scene",
        "Diesen Auftrag beenden oder aus der Reihe nehmen; der Szene wird nichts hinzugefügt",
        "Arrêter cette tâche, ou la retirer de la file ; rien n'est ajouté à la scène",
    ),
    (
        "Stop rendering; what is there stays, and the next run goes on from it",
        "Das Rendern beenden; was da ist, bleibt, und der nächste Lauf fährt dort fort",
        "Arrêter le rendu ; ce qui est là reste, et la prochaine fois reprend à cet endroit",
    ),
    (
        "Stop; what has been downloaded is kept, and Set Up Backend goes on from there",
        "Beenden; was geladen ist, bleibt erhalten, und Backend einrichten fährt dort fort",
        "Arrêter ; ce qui est téléchargé est gardé, et Installer le moteur reprend à cet endroit",
    ),
    (
        "Take the motion off the person; the action stays in the file, the person goes back to the rest pose",
        "Der Person die Bewegung nehmen; die Aktion bleibt in der Datei, die Person kehrt in die Ruhepose zurück",
        "Retirer le mouvement de la personne ; l'action reste dans le fichier, la personne revient au repos",
    ),
    (
        "Forget these people and remove their files; those in the scene stay",
        "Diese Personen vergessen und ihre Dateien entfernen; die in der Szene bleiben",
        "Oublier ces personnes et retirer leurs fichiers ; celles de la scène restent",
    ),
    (
        "Give the selected person the shape of the other person, who stays as they are",
        "Der gewählten Person die Form der anderen geben, die bleibt, wie sie ist",
        "Donner à la personne choisie la forme de l'autre, qui reste telle quelle",
    ),
    (
        "Remove this person from the scene; their files stay on disk for Undo, until Remove Unused Files",
        "Diese Person aus der Szene entfernen; ihre Dateien bleiben für Rückgängig, bis ungenutzte entfernt werden",
        "Retirer cette personne de la scène ; ses fichiers restent pour annuler, jusqu'au retrait des inutilisés",
    ),
    (
        "Delete the chosen pose of your own from the library, for all files",
        "Die gewählte eigene Pose aus der Bibliothek löschen, für alle Dateien",
        "Supprimer de la bibliothèque la pose personnelle choisie, pour tous les fichiers",
    ),
    (
        "Put another person like this one beside them: bones and body of their own, the same files",
        "Eine gleiche Person danebenstellen: eigene Knochen und eigener Körper, dieselben Dateien",
        "Placer à côté une personne identique : os et corps à elle, mêmes fichiers",
    ),
    (
        "Write the person's motion as the .npz files of AMASS: axis-angles, places and shape, z up",
        "Die Bewegung der Person als .npz wie bei AMASS schreiben: Achsenwinkel, Orte und Form, z oben",
        "Écrire le mouvement de la personne en .npz d'AMASS : axes-angles, positions et forme, z en haut",
    ),
    (
        "Back to Object mode; the body mesh is hidden again, its vertex group stays",
        "Zurück in den Objektmodus; das Körpernetz wird wieder verborgen, seine Vertexgruppe bleibt",
        "Retour au mode Objet ; le maillage du corps est de nouveau caché, son groupe de sommets reste",
    ),
    (
        "Find the density gain by which Cycles shows the selected person as opaque as the exact engine does",
        "Den Dichtefaktor finden, mit dem Cycles die gewählte Person so deckend zeigt wie die genaue Engine",
        "Trouver le gain de densité avec lequel Cycles montre la personne aussi opaque que le moteur exact",
    ),
    (
        "Select this person and move the view so that they fill it",
        "Diese Person auswählen und die Ansicht auf sie richten",
        "Sélectionner cette personne et cadrer la vue sur elle",
    ),
    (
        "Generate people from the seed, and add them to the scene with armatures, side by side",
        "Menschen aus dem Startwert erzeugen und mit Armaturen nebeneinander in die Szene stellen",
        "Générer des personnes à partir de la graine et les ajouter à la scène, avec armatures, côte à côte",
    ),
    (
        "Make a person of pictures from several sides, and add it to the scene with an armature",
        "Aus Bildern von mehreren Seiten einen Menschen machen und mit Armatur in die Szene stellen",
        "Faire une personne d'images prises de plusieurs côtés et l'ajouter à la scène avec une armature",
    ),
    (
        "Put the motion of an AMASS .npz, a pose file or a .bvh onto the person",
        "Der Person die Bewegung einer AMASS-.npz, einer Posendatei oder einer .bvh geben",
        "Donner à la personne le mouvement d'un .npz AMASS, d'un fichier de poses ou d'un .bvh",
    ),
    (
        "Set up the backend from a folder of wheels, without a network; every file is checked against its known hash",
        "Das Backend ohne Netz aus einem Ordner mit Paketen einrichten; jede Datei wird mit ihrer Prüfsumme verglichen",
        "Installer le moteur depuis un dossier de paquets, sans réseau ; chaque fichier est comparé à son empreinte",
    ),
    (
        "Set keyframes of the person's pose on the current frame",
        "Die Pose der Person im aktuellen Bild als Keyframes setzen",
        "Poser des clés de la pose de la personne sur l'image actuelle",
    ),
    (
        "Let the motion go on for ever, or end that again; a walk goes on from where it has got to",
        "Die Bewegung endlos weitergehen lassen oder das beenden; ein Gang geht dort weiter, wo er angekommen ist",
        "Faire durer le mouvement sans fin, ou y mettre fin ; une marche continue de là où elle est arrivée",
    ),
    (
        "Write the built-in poses as assets into a folder of your own, and add it to the asset libraries",
        "Die eingebauten Posen als Assets in einen eigenen Ordner schreiben und ihn zu den Asset-Bibliotheken nehmen",
        "Écrire les poses intégrées comme assets dans un dossier à vous, et l'ajouter aux bibliothèques d'assets",
    ),
    (
        "Make the selected person an asset with a picture, to be dragged from the Asset Browser into any file",
        "Die gewählte Person zum Asset mit Bild machen, das aus dem Asset-Browser in jede Datei gezogen werden kann",
        "Faire de la personne choisie un asset avec image, à glisser du navigateur d'assets dans tout fichier",
    ),
    (
        "Make the pose the selected person is in an asset, to be applied to anybody from the pose library",
        "Die Pose der gewählten Person zum Asset machen, das aus der Posenbibliothek auf alle angewandt werden kann",
        "Faire de la pose de la personne choisie un asset, à appliquer à quiconque depuis la bibliothèque de poses",
    ),
    (
        "Make one volume of the selected person's, as posed now, which Cycles draws far faster",
        "Aus den Volumen der gewählten Person in ihrer Pose eines machen, das Cycles viel schneller zeichnet",
        "Faire un seul volume de ceux de la personne choisie, dans sa pose, que Cycles dessine bien plus vite",
    ),
    (
        "Let left and right of the person's pose change places",
        "Links und rechts der Pose der Person vertauschen",
        "Échanger la gauche et la droite de la pose de la personne",
    ),
    (
        "Show variations of the selected person, with the same body, instead of these",
        "Statt dieser Varianten solche der gewählten Person mit demselben Körper zeigen",
        "Montrer à la place des variantes de la personne choisie, avec le même corps",
    ),
    (
        "Open the manual's page about this in the browser; no network is needed",
        "Die Seite des Handbuchs dazu im Browser öffnen; ein Netz ist nicht nötig",
        "Ouvrir dans le navigateur la page du manuel à ce sujet ; sans réseau",
    ),
    (
        "Show the body mesh of the selected person and paint on it where to change them",
        "Das Körpernetz der gewählten Person zeigen und darauf malen, wo sie geändert werden soll",
        "Montrer le maillage du corps de la personne choisie et y peindre où la changer",
    ),
    (
        "Show the cameras around the active object, or take them away again",
        "Die Kameras um das aktive Objekt zeigen oder wieder wegnehmen",
        "Montrer les caméras autour de l'objet actif, ou les retirer",
    ),
    (
        "Put a random seed into the panel",
        "Einen zufälligen Startwert ins Feld setzen",
        "Mettre une graine aléatoire dans le panneau",
    ),
    (
        "Give the selected person a body at random; the same seed is the same body",
        "Der gewählten Person einen zufälligen Körper geben; derselbe Startwert ist derselbe Körper",
        "Donner à la personne choisie un corps au hasard ; la même graine donne le même corps",
    ),
    (
        "Generate a region of the selected person anew; everything else stays exactly as it is",
        "Einen Bereich der gewählten Person neu erzeugen; alles andere bleibt genau, wie es ist",
        "Générer de nouveau une région de la personne choisie ; tout le reste demeure exactement tel quel",
    ),
    (
        "Delete the private environment and the caches; people in your files stay as they are",
        "Die eigene Umgebung und die Zwischenspeicher löschen; Menschen in Ihren Dateien bleiben, wie sie sind",
        "Supprimer l'environnement privé et les caches ; les personnes de vos fichiers restent telles quelles",
    ),
    (
        "Render everybody in the folder of people from all sides, into the folder of captures",
        "Alle im Ordner der Menschen von allen Seiten in den Ordner der Aufnahmen rendern",
        "Rendre tous ceux du dossier de personnes, de tous les côtés, dans le dossier de captures",
    ),
    (
        "Compare every installed file with its record, and set up anew where one differs or something is missing",
        "Jede installierte Datei mit ihrem Eintrag vergleichen und neu einrichten, wo eine abweicht oder etwas fehlt",
        "Comparer chaque fichier installé à son registre, et réinstaller ce qui diffère ou manque",
    ),
    (
        "Bring the person back to the rest pose",
        "Die Person in die Ruhepose zurückbringen",
        "Ramener la personne à la pose de repos",
    ),
    (
        "Give the selected person the shape they were generated with, or got from their last edit",
        "Der gewählten Person die Form geben, mit der sie erzeugt oder zuletzt bearbeitet wurde",
        "Rendre à la personne choisie la forme de sa génération, ou de sa dernière modification",
    ),
    (
        "Give the selected person a shape: numbers, or a height and a weight to reach from there",
        "Der gewählten Person eine Form geben: Zahlen, oder eine Größe und ein Gewicht als Ziel",
        "Donner une forme à la personne choisie : des nombres, ou une taille et un poids à atteindre",
    ),
    (
        "Keep the person's pose in the library, for this and other files",
        "Die Pose der Person in der Bibliothek behalten, für diese und andere Dateien",
        "Garder la pose de la personne dans la bibliothèque, pour ce fichier et d'autres",
    ),
    (
        "Make the armature of this person the active object, and the only one selected",
        "Die Armatur dieser Person zum aktiven und einzigen gewählten Objekt machen",
        "Faire de l'armature de cette personne l'objet actif, et le seul sélectionné",
    ),
    (
        "Choose how the selected person's volumes follow the body",
        "Wählen, wie die Volumen der gewählten Person dem Körper folgen",
        "Choisir comment les volumes de la personne choisie suivent le corps",
    ),
    (
        "Download the backend's packages into a private environment and try it; what was begun before goes on",
        "Die Pakete des Backends in eine eigene Umgebung laden und sie erproben; Begonnenes wird fortgesetzt",
        "Télécharger les paquets du moteur dans un environnement privé et l'essayer ; ce qui est commencé continue",
    ),
    (
        "Start the backend that is named or set up, and generate a person in a few steps",
        "Das genannte oder eingerichtete Backend starten und in wenigen Schritten einen Menschen erzeugen",
        "Démarrer le moteur nommé ou installé, et générer une personne en quelques étapes",
    ),
    (
        "Give a region of the selected person the texture of another one, or the garment",
        "Einem Bereich der gewählten Person die Textur oder das Kleidungsstück einer anderen geben",
        "Donner à une région de la personne choisie la texture d'une autre, ou le vêtement",
    ),
    (
        "Make the selected person an ordinary collection again; nothing of them is removed",
        "Die gewählte Person wieder zu einer gewöhnlichen Sammlung machen; nichts von ihr wird entfernt",
        "Refaire de la personne choisie une collection ordinaire ; rien d'elle n'est retiré",
    ),
    (
        "Show the person's own volumes again and remove the merged one",
        "Die eigenen Volumen der Person wieder zeigen und das vereinte entfernen",
        "Montrer de nouveau les volumes de la personne et retirer le volume fusionné",
    ),
    (
        "Let the person move by another action of this file",
        "Die Person sich nach einer anderen Aktion dieser Datei bewegen lassen",
        "Faire bouger la personne selon une autre action de ce fichier",
    ),
    (
        "Take over the settings of this preset",
        "Die Einstellungen dieser Voreinstellung übernehmen",
        "Reprendre les réglages de ce préréglage",
    ),
    (
        "Put the seed of the selected person into the panel Generate and lock it there",
        "Den Startwert der gewählten Person ins Feld Erzeugen setzen und dort festhalten",
        "Mettre la graine de la personne choisie dans le panneau Générer et l'y verrouiller",
    ),
    (
        "Show many people to choose from, before any is built",
        "Viele Menschen zur Auswahl zeigen, bevor einer aufgebaut wird",
        "Montrer beaucoup de personnes au choix, avant d'en construire une",
    ),
    (
        "Turn the selected person into a neighbour: similar, more so the smaller the amount",
        "Die gewählte Person in eine ähnliche verwandeln: umso ähnlicher, je kleiner die Stärke",
        "Changer la personne choisie en une voisine : d'autant plus semblable que la quantité est petite",
    ),
    (
        "Read every file of the captures and name what is missing, cut short or altered",
        "Jede Datei der Aufnahmen lesen und nennen, was fehlt, abgeschnitten oder verändert ist",
        "Lire chaque fichier des captures et nommer ce qui manque, est tronqué ou altéré",
    ),
    (
        "What the person is asked to be",
        "Was die Person sein soll",
        "Ce que la personne doit être",
    ),
    (
        "How far the new person may be from this one: 0 is the same, 1 anybody",
        "Wie weit die neue Person von dieser entfernt sein darf: 0 ist dieselbe, 1 irgendjemand",
        "Combien la nouvelle personne peut différer de celle-ci : 0 la même, 1 n'importe qui",
    ),
    (
        "How much of the other person: 0 is this one, 1 the other",
        "Wie viel von der anderen Person: 0 ist diese, 1 die andere",
        "Combien de l'autre personne : 0 celle-ci, 1 l'autre",
    ),
    (
        "Where to change the person; everything else stays exactly as it is",
        "Wo die Person geändert wird; alles andere bleibt genau, wie es ist",
        "Où changer la personne ; tout le reste demeure exactement tel quel",
    ),
    (
        "Another seed is another result; the same seed is the same",
        "Ein anderer Startwert ist ein anderes Ergebnis; derselbe ist dasselbe",
        "Une autre graine, un autre résultat ; la même graine, le même",
    ),
    (
        "How the body differs from the mean one, in standard deviations of people",
        "Wie der Körper vom mittleren abweicht, in Standardabweichungen der Menschen",
        "En quoi le corps diffère du corps moyen, en écarts types de la population",
    ),
    (
        "Metres from sole to crown at rest, barefoot; weight and proportions follow",
        "Meter von der Sohle bis zum Scheitel, barfuß; Gewicht und Proportionen folgen",
        "Mètres de la plante au sommet de la tête, pieds nus ; poids et proportions suivent",
    ),
    (
        "Kilograms of the body without clothes; the height stays",
        "Kilogramm des Körpers ohne Kleidung; die Größe bleibt",
        "Kilogrammes du corps sans vêtements ; la taille reste",
    ),
    (
        "Left and right change places",
        "Links und rechts tauschen",
        "La gauche et la droite s'échangent",
    ),
    (
        "Distance between samples along a ray: smaller is slower and finer",
        "Abstand der Abtastungen auf einem Strahl: kleiner ist langsamer und feiner",
        "Distance entre échantillons sur un rayon : plus petite, plus lent et plus fin",
    ),
    (
        "How strongly the attributes are followed: 1 as people are, more exaggerates; "
        "without attributes it does nothing",
        "Wie stark die Merkmale befolgt werden: 1 wie Menschen sind, mehr übertreibt; ohne Merkmale ohne Wirkung",
        "Combien les attributs sont suivis : 1 comme sont les gens, plus exagère ; sans attributs, sans effet",
    ),
    (
        "Keep the seed; otherwise each new person leaves a new random one",
        "Den Startwert behalten; sonst hinterlässt jede neue Person einen neuen zufälligen",
        "Garder la graine ; sinon chaque nouvelle personne en laisse une nouvelle, aléatoire",
    ),
    (
        "How carefully the noise is taken away",
        "Wie sorgfältig das Rauschen entfernt wird",
        "Avec quel soin le bruit est enlevé",
    ),
    (
        "How the noise is taken away",
        "Wie das Rauschen entfernt wird",
        "Comment le bruit est enlevé",
    ),
    (
        "Another seed is another person; the same seed is the same person",
        "Ein anderer Startwert ist eine andere Person; derselbe ist dieselbe Person",
        "Une autre graine, une autre personne ; la même graine, la même personne",
    ),
    (
        "Denoising steps: more take longer and add detail",
        "Entrauschungsschritte: mehr dauern länger und bringen Einzelheiten",
        "Étapes de débruitage : davantage dure plus longtemps et ajoute des détails",
    ),
    (
        "How many people to choose from",
        "Wie viele Menschen zur Auswahl stehen",
        "Combien de personnes au choix",
    ),
    (
        "Add a textured mesh of the selected person that follows the armature: fast in any viewport and engine",
        "Ein texturiertes Netz der gewählten Person hinzufügen, das der Armatur folgt: überall schnell zu zeigen",
        "Ajouter un maillage texturé de la personne choisie qui suit l'armature : rapide dans tout moteur",
    ),
    (
        "Copy what a bug report needs: versions, device, the last error and the log, without names and folders",
        "Kopieren, was ein Fehlerbericht braucht: Versionen, Gerät, letzter Fehler, Protokoll, ohne Namen und Ordner",
        "Copier ce qu'il faut à un rapport d'erreur : versions, périphérique, dernière erreur, journal, sans noms",
    ),
    (
        "Export the selected person in the current pose as 3D Gaussians for splat viewers",
        "Die gewählte Person in der aktuellen Pose als 3D-Gaußsche exportieren",
        "Exporter la personne choisie dans la pose actuelle en gaussiennes 3D",
    ),
    (
        "Export the selected person as a .human file, to be dropped into another scene or given to somebody else",
        "Die gewählte Person als .human-Datei exportieren, für eine andere Szene oder jemand anderen",
        "Exporter la personne choisie en fichier .human, à déposer dans une autre scène ou à donner",
    ),
    (
        "Export the selected person as a textured mesh with their armature",
        "Die gewählte Person als texturiertes Netz mit ihrer Armatur exportieren",
        "Exporter la personne choisie en maillage texturé avec son armature",
    ),
    (
        "Export the selected person as one volume file for each frame, for any renderer that reads OpenVDB",
        "Die gewählte Person als eine Volumendatei je Bild exportieren, für jeden Renderer, der OpenVDB liest",
        "Exporter la personne choisie en un fichier de volume par image, pour tout moteur qui lit OpenVDB",
    ),
    (
        "Add the person of a .human file to the scene",
        "Die Person einer .human-Datei in die Szene stellen",
        "Ajouter à la scène la personne d'un fichier .human",
    ),
    (
        "Make one volume for each frame of the scene's range; you can work on meanwhile",
        "Für jedes Bild des Szenenbereichs ein Volumen machen; Sie können derweil weiterarbeiten",
        "Faire un volume pour chaque image de la plage de la scène ; on peut continuer à travailler",
    ),
    (
        "End the processes that generate and draw, and so give back what they hold; the next person starts them anew",
        "Erzeugende und zeichnende Prozesse beenden, ihren Speicher zurückgeben; die nächste Person startet sie",
        "Terminer les processus qui génèrent et dessinent, et rendre leur mémoire ; la prochaine personne les relance",
    ),
    (
        "Remove the mesh proxy of the selected person and show the volumes",
        "Das Ersatznetz der gewählten Person entfernen und die Volumen zeigen",
        "Retirer le maillage de substitution de la personne choisie et montrer les volumes",
    ),
    (
        "Render with Cycles: people are approximated, shadows and lights on other objects are right",
        "Mit Cycles rendern: Menschen sind genähert, Schatten und Licht auf anderen Objekten stimmen",
        "Rendre avec Cycles : les personnes sont approchées, ombres et lumières des autres objets sont justes",
    ),
    (
        "Render with PrimDiffusion: exact, seconds a picture; other objects are shaded simply",
        "Mit PrimDiffusion rendern: genau, Sekunden je Bild; andere Objekte sind einfach schattiert",
        "Rendre avec PrimDiffusion : exact, quelques secondes par image ; les autres objets sont ombrés simplement",
    ),
    (
        "Choose what is seen of the selected person: the volumes, or the mesh proxy",
        "Wählen, was von der gewählten Person zu sehen ist: die Volumen oder das Ersatznetz",
        "Choisir ce qu'on voit de la personne choisie : les volumes, ou le maillage de substitution",
    ),
    (
        "Ask for the same once more",
        "Dasselbe noch einmal verlangen",
        "Demander la même chose encore une fois",
    ),
    (
        "Look for files of people that are missing, and make those again that cannot be found",
        "Nach fehlenden Dateien der Menschen suchen und neu machen, was nicht zu finden ist",
        "Chercher les fichiers de personnes qui manquent, et refaire ceux qui sont introuvables",
    ),
    (
        "Choose a folder to look in for files of people that are missing",
        "Einen Ordner wählen, in dem nach fehlenden Dateien der Menschen gesucht wird",
        "Choisir un dossier où chercher les fichiers de personnes qui manquent",
    ),
    (
        "Generate this person once more from their seed, where all of their files are lost",
        "Diesen Menschen nochmals aus seinem Startwert erzeugen, wenn alle seine Dateien verloren sind",
        "Générer à nouveau cette personne à partir de sa graine, quand tous ses fichiers sont perdus",
    ),
    (
        "Copy all files of this file's people beside it, so that it can be moved or sent with one folder",
        "Alle Dateien der Menschen neben diese Datei kopieren, damit beide zusammen verschoben werden können",
        "Copier tous les fichiers des personnes à côté de ce fichier, pour les déplacer ensemble",
    ),
    ("Forget works that were left", "Übrige Aufträge vergessen", "Oublier les tâches restantes"),
    (
        "Put works that were left in line again: those asked for in the open file, for their scenes",
        "Übrige Aufträge wieder einreihen: die der offenen Datei, für ihre Szenen",
        "Remettre en file les tâches restantes : celles du fichier ouvert, pour leurs scènes",
    ),
)
